// Vectors of three numbers, and rotations.

/** @typedef {[number, number, number]} Vec */
/** @typedef {[number, number, number, number]} Quat wxyz */
/** @typedef {{right: Vec, down: Vec, ahead: Vec}} Axes those of a camera */

/** @type {(a: Vec, b: Vec) => number} */
export const dot = ([a, b, c], [x, y, z]) => a * x + b * y + c * z;

/** @type {(a: Vec, b: Vec) => Vec} */
export const cross = ([a, b, c], [x, y, z]) => [b * z - c * y, c * x - a * z, a * y - b * x];

/** `a + by * b`. @type {(a: Vec, b: Vec, by?: number) => Vec} */
export const add = ([a, b, c], [x, y, z], by = 1) => [a + by * x, b + by * y, c + by * z];

/** @type {(a: Vec, b: Vec) => Vec} */
export const subtract = (a, b) => add(a, b, -1);

/** @type {(a: Vec, by: number) => Vec} */
export const scaled = ([x, y, z], by) => [by * x, by * y, by * z];

/** @type {(a: Vec) => number} */
export const norm = a => Math.hypot(...a);

/** @type {(a: Vec) => Vec} */
export const unit = a => scaled(a, 1 / norm(a));

/** A vector turned about a unit vector (Rodrigues). @type {(v: Vec, axis: Vec, angle: number) => Vec} */
export const turned = (v, axis, angle) => {
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    return add(add(scaled(v, c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
};

/** The axes of a camera from the rotation of world_from_cam. @type {(quat: Quat) => Axes} */
export const axesOf = ([w, x, y, z]) => ({
    right: [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    down: [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    ahead: [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
});

/** The inverse of `axesOf`. The largest component is computed first. @type {(axes: Axes) => Quat} */
export const quatOf = ({ right: [a, b, c], down: [d, e, f], ahead: [g, h, i] }) => {
    /** @type {Quat[]} */
    const rows = [
        [1 + a + e + i, f - h, g - c, b - d],
        [f - h, 1 + a - e - i, b + d, g + c],
        [g - c, b + d, 1 - a + e - i, f + h],
        [b - d, g + c, f + h, 1 - a - e + i],
    ];
    const best = rows.reduce((found, row, k) => (row[k] > rows[found][found] ? k : found), 0);
    const length = Math.hypot(...rows[best]);
    return /** @type {Quat} */ (rows[best].map(value => value / length));
};
