// Which Gaussians are in a shape of the window, or outside a box. Matrices are column by column, as the
// engine has them.

const SHORT = 8;

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
        const x = centers[at],
            y = centers[at + 1],
            z = centers[at + 2];
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

/**
 * How far a point must move along an axis, so that it is seen nearest to a place of the window; null if
 * no such distance is known: the axis is seen from its end, or the place is beyond its vanishing point.
 * @param {ArrayLike<number>} m the clip space from the space of the point
 * @param {number[]} point
 * @param {number} axis 0, 1 or 2
 * @param {number} length along the axis, which is seen from its end if these are fewer than `SHORT` pixels
 * @param {number[]} place pixels
 * @param {number} width
 * @param {number} height
 */
export function along(m, point, axis, length, [column, row], width, height) {
    const [x, y, w] = project(m, point, width, height);
    // The numerators of column and row, and their denominator, change by these for each unit.
    const further = m[4 * axis + 3];
    const across = 0.5 * width * (m[4 * axis] + further);
    const down = 0.5 * height * (further - m[4 * axis + 1]);
    const [dx, dy] = [(across - x * further) / w, (down - y * further) / w]; // pixels per unit
    const speed = Math.hypot(dx, dy);
    const moved = (dx * (column - x) + dy * (row - y)) / speed;
    const left = speed * w - moved * further;
    return w > 0 && speed * length > SHORT && left > 1e-3 * speed * w ? (moved * w) / left : null;
}
