// Rotations as unit quaternions wxyz, in a world whose y axis points up.

export const UNTURNED = [1, 0, 0, 0];

/** The rotation by b, and then by a. */
export function product(/** @type {number[]} */ [a, b, c, d], /** @type {number[]} */ [w, x, y, z]) {
    return [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ];
}

export const inverse = (/** @type {number[]} */ [w, x, y, z]) => [w, -x, -y, -z];

/** A point, turned about another one. */
export function turned(/** @type {number[]} */ turn, /** @type {number[]} */ point, /** @type {number[]} */ middle) {
    const from = point.map((value, k) => value - middle[k]);
    const [, ...to] = product(product(turn, [0, ...from]), inverse(turn));
    return to.map((value, k) => value + middle[k]);
}

/** The rotation by an angle, in degrees, about axis 0, 1 or 2. */
export function about(/** @type {number} */ axis, /** @type {number} */ degrees) {
    const half = (degrees * Math.PI) / 360;
    return [Math.cos(half), ...[0, 1, 2].map(k => (k === axis ? Math.sin(half) : 0))];
}

const cross = (/** @type {number[]} */ [a, b, c], /** @type {number[]} */ [d, e, f]) => [
    b * f - c * e,
    c * d - a * f,
    a * e - b * d,
];
const minus = (/** @type {number[]} */ a, /** @type {number[]} */ b) => a.map((value, k) => value - b[k]);

/**
 * The shortest rotation that makes a floor level. The side that the eye sees is its upper side.
 * @param {number[][]} floor three of its points
 * @param {number[]} eye
 * @returns {number[] | null} null: the points are on a line
 */
export function levelling([a, b, c], eye) {
    const [ab, ac, toEye] = [minus(b, a), minus(c, a), minus(eye, a)];
    const normal = cross(ab, ac);
    const area = Math.hypot(...normal);
    if (!(area > 1e-3 * Math.hypot(...ab) * Math.hypot(...ac))) return null;
    const above = normal.reduce((sum, value, k) => sum + value * toEye[k], 0) < 0 ? -area : area;
    const [x, y, z] = normal.map(value => value / above);
    // Half of the way to y: the sum of both directions. It is 0 for the opposite of y.
    const length = Math.hypot(1 + y, z, x);
    return length < 1e-9 ? about(0, 180) : [(1 + y) / length, -z / length, 0, x / length];
}
