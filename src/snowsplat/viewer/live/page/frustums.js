// The cameras of the photos, drawn over the image, as pyramids with the photo at their base.
import { add, axesOf, dot, subtract } from "./vectors.js";

/** @typedef {import('./vectors.js').Vec} Vec */
/** @typedef {import('./camera.js').Photo} Photo */
/** @typedef {{quat: import('./vectors.js').Quat, position: Vec, fov: number}} View */
/** @typedef {{index: number, depth: number, apex: number[], base: number[][]}} Drawn in pixels */

const NEAR = 0.1; // of the length of a pyramid: nearer corners are not drawn
const REACH = 14; // pixels between a click and the middle of a pyramid

export class Frustums {
    /** @param {HTMLCanvasElement} canvas @param {Photo[]} photos @param {number} every one of so many is drawn @param {number} length */
    constructor(canvas, photos, every, length) {
        this.canvas = canvas;
        this.photos = photos;
        this.length = length;
        /** @type {Map<number, ImageBitmap>} */
        this.thumbnails = new Map();
        /** @type {Drawn[]} the nearest one last */
        this.drawn = [];
        /** @type {number | undefined} */
        this.pointed = undefined;
        this.corners = photos.map(({ quat, position, half: [across, down] }, index) => {
            if (index % every) return undefined;
            const { right, down: below, ahead } = axesOf(quat);
            const base = /** @type {Vec[]} */ (
                [
                    [-1, -1],
                    [1, -1],
                    [1, 1],
                    [-1, 1],
                ].map(([x, y]) =>
                    add(add(add(position, ahead, length), right, x * across * length), below, y * down * length),
                )
            );
            return [position, ...base];
        });
    }

    /** Draw them as they are in the image of a view. @param {View} view @param {boolean} visible */
    draw(view, visible) {
        const { canvas } = this;
        const ratio = devicePixelRatio;
        const [width, height] = [canvas.clientWidth, canvas.clientHeight];
        canvas.width = Math.round(width * ratio);
        canvas.height = Math.round(height * ratio);
        this.drawn = visible ? this.project(view, width, height) : [];
        const context = canvas.getContext("2d");
        if (!context) return;
        const style = getComputedStyle(canvas);
        context.lineJoin = "round";
        for (const each of this.drawn) {
            const { apex, base } = each;
            const thumbnail = this.thumbnails.get(each.index);
            context.setTransform(ratio, 0, 0, ratio, 0, 0);
            context.globalAlpha = each.index === this.pointed ? 1 : 0.9;
            context.lineWidth = each.index === this.pointed ? 3 : 1.5;
            context.strokeStyle = style.getPropertyValue(this.photos[each.index].heldOut ? "--held-out" : "--camera");
            const path = new Path2D();
            base.forEach(([x, y], i) => (i ? path.lineTo(x, y) : path.moveTo(x, y)));
            path.closePath();
            if (thumbnail) {
                const [[x, y], [u, v], , [p, q]] = base;
                const [w, h] = [thumbnail.width, thumbnail.height];
                context.save();
                context.clip(path);
                context.transform((u - x) / w, (v - y) / w, (p - x) / h, (q - y) / h, x, y);
                context.drawImage(thumbnail, 0, 0);
                context.restore();
            }
            for (const [x, y] of base) {
                path.moveTo(apex[0], apex[1]);
                path.lineTo(x, y);
            }
            context.stroke(path);
        }
    }

    /** @param {View} view @param {number} width @param {number} height @returns {Drawn[]} */
    project({ quat, position, fov }, width, height) {
        const { right, down, ahead } = axesOf(quat);
        const focal = height / 2 / Math.tan(fov / 2);
        /** @type {Drawn[]} */
        const found = [];
        this.corners.forEach((corners, index) => {
            if (!corners) return;
            const points = corners.map(corner => {
                const from = subtract(corner, position);
                const depth = dot(from, ahead);
                return [
                    width / 2 + (focal * dot(from, right)) / depth,
                    height / 2 + (focal * dot(from, down)) / depth,
                    depth,
                ];
            });
            if (points.some(([, , depth]) => depth < NEAR * this.length)) return;
            if (points.every(([x, y]) => x < 0 || y < 0 || x > width || y > height)) return;
            found.push({ index, depth: points[0][2], apex: points[0], base: points.slice(1) });
        });
        return found.sort((a, b) => b.depth - a.depth);
    }

    /** The photo at a point of the window. @param {number} x @param {number} y @returns {number | undefined} */
    at(x, y) {
        const within = this.drawn.filter(({ base }) => contains(base, x, y)).pop();
        if (within) return within.index;
        const far = (/** @type {Drawn} */ { apex }) => Math.hypot(apex[0] - x, apex[1] - y);
        return this.drawn
            .filter(each => far(each) < REACH)
            .sort((a, b) => far(b) - far(a))
            .pop()?.index;
    }
}

/** Whether a polygon contains a point. @param {number[][]} polygon @param {number} x @param {number} y */
const contains = (polygon, x, y) =>
    polygon.reduce((inside, [u, v], i) => {
        const [p, q] = polygon[(i + 1) % polygon.length];
        return v > y !== q > y && x < u + ((p - u) * (y - v)) / (q - v) ? !inside : inside;
    }, false);
