// The training: one photo for each step; L1 and SSIM, Adam, and density control.
import { refined } from "./density.js";
import { PARAMETERS, Renderer, STRIDE } from "./renderer.js";

/** @typedef {import('./gpu.js').Gpu} Gpu */
/** @typedef {import('./gpu.js').Buffer} Buffer */
/** @typedef {import('./density.js').Arrays} Arrays */
/** @typedef {Record<string, Buffer>} Buffers by parameter */
/** A photo: `pixels` are planar bytes. @typedef {import('./renderer.js').View & {pixels: Uint8Array, heldOut: boolean}} Photo */

/**
 * Settings of the training, as in `training/settings`; moments are steps.
 * @typedef {object} Recipe
 * @property {number} steps
 * @property {[number, number]} means first and last rate of the positions, in units of the extent
 * @property {Record<string, number>} rates of the other parameters
 * @property {number} degreeEvery steps between degrees of the spherical harmonics
 * @property {number} refineEvery
 * @property {number} refineFrom
 * @property {number} refineUntil
 * @property {number} threshold of the gradient, with the image spanning [-1, 1]
 * @property {number} dense share of the extent: larger Gaussians are split
 * @property {number} least opacity: Gaussians with less are removed
 * @property {number} most Gaussians
 * @property {[number, number][]} smaller factors of the photos, and the moments until which they are used
 * @property {number} ssim weight of 1 − SSIM in the loss
 * @property {boolean} visibleOnly
 */

const [BETA1, BETA2, EPS] = [0.9, 0.999, 1e-15];
const SMALLEST = 64; // pixels of the longer side of a smaller photo, at least
/** The operations of a step. */
export const OPERATIONS = [
    ...["project_cull", "project_fwd", "splats_prepare", "splats_sort", "tiles_count", "tiles_fill", "rasterize_fwd"],
    ...["photometric", "photometric_means", "rasterize_bwd", "splats_reduce", "accumulate_screen_statistics"],
    ...["project_rows", "adam_update"],
];
const REPORT = 32; // bytes for each step: the instances, and three means of the loss
const MOST_STEPS = 64; // between two reports

/** A generator of numbers in [0, 1) (mulberry32): a page has the same training each time. @param {number} seed */
const generator = seed => () => {
    seed = (seed + 0x6d2b79f5) | 0;
    let t = Math.imul(seed ^ (seed >>> 15), 1 | seed);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
};

/** A photo of 1 / factor of the size. @param {Photo} photo @param {number} factor @returns {Photo} */
const smaller = (photo, factor) => {
    const [width, height] = [Math.floor(photo.width / factor), Math.floor(photo.height / factor)];
    const pixels = new Uint8Array(Math.ceil((3 * width * height) / 4) * 4);
    for (let c = 0; c < 3; c++)
        for (let y = 0; y < height; y++)
            for (let x = 0; x < width; x++) {
                let sum = 0;
                for (let v = 0; v < factor; v++) {
                    const row = (c * photo.height + factor * y + v) * photo.width + factor * x;
                    for (let u = 0; u < factor; u++) sum += photo.pixels[row + u];
                }
                pixels[(c * height + y) * width + x] = Math.round(sum / factor ** 2);
            }
    const { fx, fy, cx, cy } = photo;
    return { ...photo, width, height, pixels, fx: fx / factor, fy: fy / factor, cx: cx / factor, cy: cy / factor };
};

export class Trainer {
    /**
     * @param {Gpu} gpu
     * @param {Arrays} values the first Gaussians
     * @param {Photo[]} photos
     * @param {number} extent
     * @param {Recipe} recipe
     */
    constructor(gpu, values, photos, extent, recipe) {
        this.gpu = gpu;
        this.extent = extent;
        this.recipe = recipe;
        this.steps = recipe.steps;
        this.renderer = new Renderer(gpu);
        this.training = photos.filter(photo => !photo.heldOut);
        this.heldOut = photos.filter(photo => photo.heldOut);
        this.random = generator(1);
        /** Smaller photos. @type {Map<Photo, {factor: number, photo: Photo}>} */
        this.reduced = new Map();
        /** The photos of this pass that are not used yet. @type {Photo[]} */
        this.queue = [];
        this.step = 0;
        this.loss = Number.NaN;
        this.count = 0;
        /** The parameters, and the moments of Adam. @type {[Buffers, Buffers, Buffers]} */
        this.sets = [{}, {}, {}];
        /** The sums of density control. @type {Buffer[]} */
        this.statistics = [];
        const zeros = () =>
            Object.fromEntries(Object.entries(values).map(([name, each]) => [name, new Float32Array(each.length)]));
        this.reports = gpu.make(REPORT * MOST_STEPS);
        this.valid = gpu.make(4);
        this.load({ count: values.opacity_logits.length, values, m: zeros(), v: zeros() });
    }

    /** Onto the device. @param {import('./density.js').State} state */
    load({ count, values, m, v }) {
        const { gpu } = this;
        gpu.discard(...this.sets.flatMap(each => Object.values(each)), ...this.statistics);
        const uploaded = (/** @type {Arrays} */ arrays) =>
            Object.fromEntries(Object.entries(arrays).map(([name, each]) => [name, gpu.upload(each)]));
        this.count = count;
        this.sets = [uploaded(values), uploaded(m), uploaded(v)];
        this.statistics = [gpu.make(4 * count), gpu.make(4 * count)];
    }

    get gaussians() {
        const degree = Math.min(3, Math.floor(this.step / this.recipe.degreeEvery));
        return { count: this.count, degree, buffers: this.sets[0] };
    }

    get done() {
        return this.step >= this.steps;
    }

    /** Steps until the Gaussians have to be refined, or the end. */
    get ahead() {
        return Math.min(
            this.recipe.refineEvery - (this.step % this.recipe.refineEvery),
            this.steps - this.step,
            MOST_STEPS,
        );
    }

    /** Train for some steps, at most `ahead`, and refine the Gaussians if it is time. @param {number} steps */
    async train(steps) {
        const { gpu, renderer, reports } = this;
        for (let k = 0; k < steps; k++) this.queueStep(k);
        const [told] = await gpu.read([[reports, REPORT * steps]]);
        const { capacity } = renderer;
        const losses = [];
        for (let k = 0; k < steps; k++) {
            // A step for which the memory did not suffice has changed nothing.
            if (renderer.outgrew(new Uint32Array(told, REPORT * k, 1)[0], capacity)) continue;
            const [l1, similarity] = new Float64Array(told, REPORT * k + 8, 2);
            losses.push((1 - this.recipe.ssim) * l1 + this.recipe.ssim * (1 - similarity));
        }
        if (losses.length) this.loss = losses.reduce((sum, each) => sum + each, 0) / losses.length;
        const { refineEvery, refineFrom, refineUntil } = this.recipe;
        if (this.step % refineEvery === 0 && this.step >= refineFrom && this.step <= refineUntil) await this.refine();
    }

    /** A photo in the size that the step needs. @param {Photo} photo */
    sized(photo) {
        const fits = (/** @type {number} */ factor) => Math.max(photo.width, photo.height) >= SMALLEST * factor;
        const [factor] = this.recipe.smaller.find(([by, until]) => this.step < until && fits(by)) ?? [1];
        const known = this.reduced.get(photo);
        if (factor === 1) this.reduced.delete(photo);
        if (factor === 1 || known?.factor === factor) return known && factor > 1 ? known.photo : photo;
        const made = smaller(photo, factor);
        this.reduced.set(photo, { factor, photo: made });
        return made;
    }

    /** @param {number} k number of its report */
    queueStep(k) {
        const { gpu, renderer, valid } = this;
        gpu.submit(); // what is written below must not change the step before
        if (!this.queue.length) {
            this.queue = [...this.training];
            for (let i = this.queue.length - 1; i > 0; i--) {
                const j = Math.floor(this.random() * (i + 1));
                [this.queue[i], this.queue[j]] = [this.queue[j], this.queue[i]];
            }
        }
        const photo = this.sized(/** @type {Photo} */ (this.queue.pop()));
        const frame = renderer.draw(this.gaussians, photo);
        this.step++;
        const { width, height, tiles, packed, ids, capacity, required } = frame;
        const n = this.count;
        gpu.run("show", "check_capacity", 1, { required, valid, capacity });

        const target = gpu.temporary("photo", photo.pixels.byteLength);
        gpu.device.queue.writeBuffer(target, 0, photo.pixels);
        const grad = gpu.temporary("grad_image", 12 * width * height);
        const means = gpu.temporary("means", 24);
        const values = 3 * width * height;
        const loss = {
            ...{ n: 3, first: 0, width, height, tiles, bytes: 1, values, parts: 3 * tiles },
            ...{ l1_weight: (1 - this.recipe.ssim) / values, ssim_weight: -this.recipe.ssim / values, huber_weight: 0 },
            ...{ image: frame.image, target, grad, means },
            maps: gpu.temporary("maps", 36 * width * height),
            sums: gpu.temporary("sums", 36 * tiles),
        };
        gpu.follow("photometric", loss);
        gpu.follow("photometric_means", loss);

        const slots = gpu.temporary("slots", 64 * capacity);
        gpu.follow("rasterize_bwd", { ...frame, n: tiles, grad_image: grad, slots });
        const gradPacked = gpu.temporary("grad_packed", 4 * STRIDE * n);
        const splats = { n, packed, stride: STRIDE, columns: renderer.columns, grad_packed: gradPacked };
        gpu.follow("splats_reduce", { ...splats, slots, slot_range: frame.slot_range, channels: 3, add: 0 });
        gpu.follow("accumulate_screen_statistics", {
            ...{ ...splats, ids, width, height, grad_means: gradPacked, grad_stride: STRIDE },
            ...{ norm_sum: this.statistics[0], views: this.statistics[1], valid },
        });
        this.queueAdam({ ...frame, n, grad_packed: gradPacked });
        gpu.copy(required, this.reports, 8, REPORT * k);
        gpu.copy(means, this.reports, 24, REPORT * k + 8);
    }

    /** @param {import('./gpu.js').Values} frame */
    queueAdam(frame) {
        const { gpu, valid, step } = this;
        const degree = frame.gaussians_sh_degree;
        const width = 11 + 3 * (degree + 1) ** 2;
        const rows = { first: 0, count: this.count, width, rows: gpu.temporary("rows", 4 * width * this.count) };
        gpu.follow("project_rows", { ...frame, ...rows });
        const share = Math.min(1, step / this.steps);
        const [first, last] = this.recipe.means;
        const means = this.extent * first ** (1 - share) * last ** share;
        const rates = /** @type {Record<string, number>} */ ({ ...this.recipe.rates, means });
        const parameters = Object.keys(PARAMETERS).flatMap(name => [
            ...["value", "m", "v"].map((part, k) => [`${name}_${part}`, this.sets[k][name]]),
            [`${name}_rate`, rates[name] / (1 - BETA1 ** step)],
        ]);
        gpu.follow("adam_update", {
            ...Object.fromEntries(parameters),
            ...rows,
            n: this.count,
            splat_of: frame.ids,
            ...{ beta1: BETA1, beta2: BETA2, gain1: 1 - BETA1, gain2: 1 - BETA2, eps2: EPS * EPS },
            inv_correction2: 1 / (1 - BETA2 ** step),
            sh_columns: width - 14,
            sh_stride: PARAMETERS.sh_rest,
            visible_only: Number(this.recipe.visibleOnly),
            valid,
        });
    }

    /** What the device has. @returns {Promise<import('./density.js').State>} */
    async state() {
        const names = /** @type {(keyof typeof PARAMETERS)[]} */ (Object.keys(PARAMETERS));
        const wanted = this.sets.flatMap(set =>
            names.map(name => /** @type {[Buffer, number]} */ ([set[name], 4 * PARAMETERS[name] * this.count])),
        );
        const read = (await this.gpu.read(wanted)).map(content => new Float32Array(content));
        const [values, m, v] = this.sets.map((_, k) =>
            Object.fromEntries(names.map((name, i) => [name, read[k * names.length + i]])),
        );
        return { count: this.count, values, m, v };
    }

    async refine() {
        const size = 4 * this.count;
        const [sums, views] = (await this.gpu.read(this.statistics.map(each => [each, size]))).map(
            each => new Float32Array(each),
        );
        const gradients = sums.map((sum, i) => sum / Math.max(1, views[i]));
        this.load(refined(await this.state(), gradients, this.extent, this.recipe, this.random));
    }

    /** The PSNR of the photos that are held out, or of some of the others, in dB. */
    async psnr() {
        const among = this.heldOut.length ? this.heldOut : this.training;
        const chosen = among.slice(0, 4);
        let sum = 0;
        for (const photo of chosen) {
            const made = await this.renderer.picture(this.gaussians, photo);
            const size = photo.width * photo.height;
            let error = 0;
            for (let i = 0; i < size; i++)
                for (let c = 0; c < 3; c++) error += (made[4 * i + c] - photo.pixels[c * size + i]) ** 2;
            sum += 10 * Math.log10((255 ** 2 * 3 * size) / Math.max(error, 1e-9));
        }
        return sum / chosen.length;
    }
}
