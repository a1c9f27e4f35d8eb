// Which Gaussians are selected or deleted: a byte per Gaussian; how the scene is turned, a quaternion
// wxyz; and what undoes a change. Matrices are column by column, as the engine has them.

import { product, UNTURNED } from "./turning.js";

export const SELECTED = 1;
export const DELETED = 2;

const STEPS = 40; // that can be undone

/** The product of two matrices of 16 numbers. */
export function times(/** @type {ArrayLike<number>} */ a, /** @type {ArrayLike<number>} */ b) {
    const product = new Float64Array(16);
    for (let column = 0; column < 4; column++)
        for (let row = 0; row < 4; row++)
            for (let k = 0; k < 4; k++) product[4 * column + row] += a[4 * k + row] * b[4 * column + k];
    return product;
}

/**
 * The place of a point in a window, and its depth; behind the camera, the depth is not positive.
 * @param {ArrayLike<number>} m the clip space from the space of the point
 * @param {number[]} point
 * @param {number} width
 * @param {number} height
 */
export function project(m, [x, y, z], width, height) {
    const w = m[3] * x + m[7] * y + m[11] * z + m[15];
    const across = (m[0] * x + m[4] * y + m[8] * z + m[12]) / w;
    const up = (m[1] * x + m[5] * y + m[9] * z + m[13]) / w;
    return [(0.5 + 0.5 * across) * width, (0.5 - 0.5 * up) * height, w];
}

/**
 * A byte per Gaussian: whether its centre is in a shape of the window, at any depth.
 * @param {Float32Array} centers (N, 3)
 * @param {ArrayLike<number>} m the clip space from the space of the centres
 * @param {Uint8Array} shape a byte per pixel of the window, row by row; not 0: in the shape
 * @param {number} width
 * @param {number} height
 */
export function within(centers, m, shape, width, height) {
    const found = new Uint8Array(centers.length / 3);
    const [halfWidth, halfHeight] = [0.5 * width, 0.5 * height];
    for (let i = 0, at = 0; i < found.length; i++, at += 3) {
        const x = centers[at], y = centers[at + 1], z = centers[at + 2];
        const w = m[3] * x + m[7] * y + m[11] * z + m[15];
        if (!(w > 0)) continue;
        const column = halfWidth + (halfWidth * (m[0] * x + m[4] * y + m[8] * z + m[12])) / w;
        const row = halfHeight - (halfHeight * (m[1] * x + m[5] * y + m[9] * z + m[13])) / w;
        if (column >= 0 && column < width && row >= 0 && row < height)
            found[i] = shape[(row | 0) * width + (column | 0)] && 1;
    }
    return found;
}

/**
 * A byte per Gaussian: whether its centre is outside a box.
 * @param {Float32Array} centers (N, 3)
 * @param {ArrayLike<number>} low the corner with the lowest coordinates
 * @param {ArrayLike<number>} high the opposite one
 */
export function outside(centers, low, high) {
    const found = new Uint8Array(centers.length / 3);
    for (let i = 0, at = 0; i < found.length; i++, at += 3)
        for (let axis = 0; axis < 3; axis++)
            if (!(centers[at + axis] >= low[axis] && centers[at + axis] <= high[axis])) found[i] = 1;
    return found;
}

/** The bounds [low, high] of all but a hundredth of the centres at each end of each axis. */
export function bounds(/** @type {Float32Array} */ centers) {
    const step = Math.ceil(centers.length / 3 / 50000) || 1;
    const sides = [0, 1, 2].map(axis => {
        const values = [];
        for (let at = axis; at < centers.length; at += 3 * step) values.push(centers[at]);
        const sorted = Float32Array.from(values).sort();
        const end = Math.floor(0.01 * (sorted.length - 1));
        return [sorted[end], sorted[sorted.length - 1 - end]];
    });
    return [sides.map(side => side[0]), sides.map(side => side[1])];
}

export class Selection {
    /** @param {number} count of Gaussians */
    constructor(count) {
        /** @type {Uint8Array} */
        this.state = new Uint8Array(count);
        this.turn = UNTURNED;
        /** @type {[Uint8Array, number[]][]} */
        this.past = [];
        /** @type {[Uint8Array, number[]][]} */
        this.future = [];
    }

    /** Changes the state; a change of nothing is no step. */
    #change(/** @type {(byte: number, i: number) => number} */ changed) {
        const next = this.state.map(changed);
        if (!next.every((byte, i) => byte === this.state[i])) this.#step(next, this.turn);
    }

    #step(/** @type {Uint8Array} */ state, /** @type {number[]} */ turn) {
        this.past.push([this.state, this.turn]);
        if (this.past.length > STEPS) this.past.shift();
        this.future.length = 0;
        [this.state, this.turn] = [state, turn];
    }

    /** Turns the scene further. */
    turnBy(/** @type {number[]} */ quaternion) {
        this.#step(this.state, product(quaternion, this.turn));
    }

    /**
     * Selects what was found. What is deleted is never selected.
     * @param {Uint8Array} found a byte per Gaussian
     * @param {string} mode "replace", "add" or "remove"
     */
    select(found, mode) {
        this.#change((byte, i) => {
            if (byte === DELETED) return byte;
            if (mode === "replace") return found[i];
            return found[i] ? Number(mode === "add") : byte;
        });
    }

    invert() {
        this.#change(byte => (byte === DELETED ? byte : byte ^ SELECTED));
    }

    delete() {
        this.#change(byte => (byte === SELECTED ? DELETED : byte));
    }

    undo() {
        this.#go(this.past, this.future);
    }

    redo() {
        this.#go(this.future, this.past);
    }

    #go(/** @type {[Uint8Array, number[]][]} */ from, /** @type {[Uint8Array, number[]][]} */ to) {
        const next = from.pop();
        if (!next) return;
        to.push([this.state, this.turn]);
        [this.state, this.turn] = next;
    }

    /** @param {number} value SELECTED or DELETED */
    count(value) {
        return this.state.reduce((sum, byte) => sum + Number(byte === value), 0);
    }

    /** A bit per Gaussian, the lowest bit of a byte first: whether it is deleted. In base64. */
    deleted() {
        const bytes = new Uint8Array(Math.ceil(this.state.length / 8));
        this.state.forEach((byte, i) => {
            if (byte === DELETED) bytes[i >> 3] |= 1 << (i & 7);
        });
        let text = "";
        for (let at = 0; at < bytes.length; at += 1 << 14) text += String.fromCharCode(...bytes.subarray(at, at + (1 << 14)));
        return btoa(text);
    }
}
