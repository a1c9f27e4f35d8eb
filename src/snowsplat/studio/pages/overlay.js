// A canvas over the window, for what the tools of the editor draw.

import { make } from "./page.js";
import { project } from "./selection.js";
import { say } from "./text.js";

/** A colour of `theme.css`. */
export const colour = (/** @type {string} */ name) =>
    getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);

/** @param {HTMLCanvasElement} canvas of the viewer */
export function addOverlay(canvas) {
    const element = /** @type {HTMLCanvasElement} */ (
        make("canvas.snow-overlay", { hidden: true, role: "application", "aria-label": say("edit_cross") })
    );
    const drawing = /** @type {CanvasRenderingContext2D} */ (element.getContext("2d"));
    canvas.after(element);
    // Zoom works with every tool.
    element.addEventListener("wheel", event => {
        event.preventDefault();
        canvas.dispatchEvent(new WheelEvent("wheel", event));
    });
    const seen = (/** @type {Float64Array} */ m, /** @type {number[]} */ point) =>
        project(m, point, canvas.clientWidth, canvas.clientHeight);
    return {
        element,
        drawing,
        clear() {
            const { clientWidth: width, clientHeight: height } = canvas;
            const ratio = devicePixelRatio;
            if (element.width !== Math.round(width * ratio) || element.height !== Math.round(height * ratio)) {
                element.width = Math.round(width * ratio);
                element.height = Math.round(height * ratio);
            }
            drawing.setTransform(ratio, 0, 0, ratio, 0, 0);
            drawing.clearRect(0, 0, width, height);
        },
        /**
         * A dot at a point, or a number in it.
         * @param {Float64Array} m the clip space from the space of the point
         * @param {number[]} point
         * @param {string} number
         */
        mark(m, point, number) {
            const [x, y, depth] = seen(m, point);
            if (depth <= 0) return;
            drawing.beginPath();
            drawing.arc(x, y, number ? 11 : 5, 0, 7);
            drawing.fillStyle = colour("amber");
            drawing.fill();
            drawing.fillStyle = colour("night");
            drawing.textAlign = "center";
            drawing.fillText(number, x, y + 4);
        },
        /**
         * Lines between pairs of points; those behind the camera are not drawn.
         * @param {Float64Array} m the clip space from the space of the points
         * @param {number[][][]} pairs
         */
        lines(m, pairs) {
            drawing.lineWidth = 2;
            drawing.strokeStyle = colour("amber");
            drawing.beginPath();
            for (const pair of pairs) {
                const [from, to] = pair.map(point => seen(m, point));
                if (from[2] <= 0 || to[2] <= 0) continue;
                drawing.moveTo(from[0], from[1]);
                drawing.lineTo(to[0], to[1]);
            }
            drawing.stroke();
        },
    };
}
