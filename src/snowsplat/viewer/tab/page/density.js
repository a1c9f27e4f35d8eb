// Adaptive density control, as in `training/density/adaptive.py`: Gaussians where the gradient of the
// position is large are cloned if they are small, and split if they are large; transparent ones are removed.
import { PARAMETERS } from "./renderer.js";

/** @typedef {Record<string, Float32Array>} Arrays by parameter */
/** @typedef {{count: number, values: Arrays, m: Arrays, v: Arrays}} State on the CPU */

const SHRINK = 1.6; // of the scales in a split

/** A number of the normal distribution. @param {() => number} random */
const normal = random => Math.sqrt(-2 * Math.log(1 - random())) * Math.cos(2 * Math.PI * random());

/** R S ε of a Gaussian. @param {Arrays} values @param {number} i @param {() => number} random */
const offset = ({ log_scales, quats }, i, random) => {
    const [a, b, c] = [0, 1, 2].map(k => Math.exp(log_scales[3 * i + k]) * normal(random));
    const length = Math.hypot(...quats.subarray(4 * i, 4 * i + 4)) || 1;
    const [w, x, y, z] = [0, 1, 2, 3].map(k => quats[4 * i + k] / length);
    return [
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c,
        2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c,
        2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    ];
};

/**
 * The Gaussians after a refinement. Copies and children have no moments yet.
 * @param {State} state
 * @param {ArrayLike<number>} gradients the mean norms
 * @param {number} extent of the scene
 * @param {import('./trainer.js').Recipe} recipe
 * @param {() => number} random
 * @returns {State}
 */
export const refined = (
    { count, values, m, v },
    gradients,
    extent,
    { threshold, dense: large, least, most },
    random,
) => {
    const size = (/** @type {number} */ i) =>
        Math.exp(Math.max(...values.log_scales.subarray(3 * i, 3 * i + 3))) / extent;
    const logit = Math.log(least / (1 - least));
    const all = Array.from({ length: count }, (_, i) => i);
    let alive = all.filter(i => values.opacity_logits[i] >= logit);
    if (!alive.length) alive = all;
    const dense = alive
        .filter(i => gradients[i] > threshold)
        .sort((i, j) => gradients[j] - gradients[i])
        .slice(0, Math.max(0, most - alive.length));
    const split = new Set(dense.filter(i => size(i) > large));
    const kept = alive.filter(i => !split.has(i));
    const clones = dense.filter(i => !split.has(i));
    const index = [...kept, ...clones, ...split, ...split];
    const first = kept.length + clones.length; // of the children
    const rows = (/** @type {Float32Array} */ source, /** @type {number} */ width, /** @type {number} */ known) => {
        const made = new Float32Array(index.length * width);
        for (let k = 0; k < known; k++) made.set(source.subarray(index[k] * width, (index[k] + 1) * width), k * width);
        return made;
    };
    const of = (/** @type {Arrays} */ arrays, /** @type {number} */ known) =>
        Object.fromEntries(Object.entries(PARAMETERS).map(([name, width]) => [name, rows(arrays[name], width, known)]));
    const made = {
        count: index.length,
        values: of(values, index.length),
        m: of(m, kept.length),
        v: of(v, kept.length),
    };
    for (let k = first; k < index.length; k++) {
        const by = offset(values, index[k], random);
        for (let c = 0; c < 3; c++) {
            made.values.means[3 * k + c] += by[c];
            made.values.log_scales[3 * k + c] -= Math.log(SHRINK);
        }
    }
    return made;
};
