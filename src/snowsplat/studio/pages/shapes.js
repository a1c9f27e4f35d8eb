// The tools that select what is in a shape of the window: rectangle, lasso and brush.

import { colour } from "./overlay.js";
import { make } from "./page.js";
import { within } from "./selection.js";
import { say } from "./text.js";

const BRUSH = 24; // its radius at first, in CSS pixels

/** @param {import("./edit.js").Editing} editing */
export function addShapes({ canvas, centers, overlay, model, select }) {
    let name = "";
    /** @type {number[][]} */
    let stroke = []; // points of the window, CSS pixels
    const radius = /** @type {HTMLInputElement} */ (make("input", { type: "range", min: 4, max: 120, value: BRUSH }));
    const size = make("output", {}, `${BRUSH} px`);
    const element = make("label", {}, say("edit_radius"), radius, size);
    radius.addEventListener("input", () => (size.textContent = `${radius.value} px`));

    /** Draws the stroke as a rectangle, an area or a line. */
    function trace(/** @type {CanvasRenderingContext2D} */ context) {
        const [first, last] = [stroke[0], stroke[stroke.length - 1]];
        context.beginPath();
        if (name === "rectangle") context.rect(first[0], first[1], last[0] - first[0], last[1] - first[1]);
        else stroke.forEach(([x, y]) => context.lineTo(x, y));
        if (name !== "brush") return context.fill();
        context.lineTo(last[0] + 0.01, last[1]); // a point has a round end, too
        context.lineWidth = 2 * Number(radius.value);
        context.lineCap = context.lineJoin = "round";
        context.stroke();
    }

    function selectStroke(/** @type {PointerEvent} */ event) {
        const { clientWidth: width, clientHeight: height } = canvas;
        const context = /** @type {CanvasRenderingContext2D} */ (
            Object.assign(document.createElement("canvas"), { width, height }).getContext("2d")
        );
        trace(context);
        const pixels = context.getImageData(0, 0, width, height).data;
        const shape = new Uint8Array(width * height);
        for (let i = 0; i < shape.length; i++) shape[i] = pixels[4 * i + 3];
        stroke = [];
        select(within(centers, model(), shape, width, height), event);
    }

    overlay.element.addEventListener("pointermove", event => {
        if (stroke.length && event.isPrimary) stroke.push([event.offsetX, event.offsetY]);
    });
    overlay.element.addEventListener("pointerup", event => {
        if (stroke.length && event.isPrimary) selectStroke(event);
    });
    overlay.element.addEventListener("pointercancel", () => (stroke = []));
    return {
        element,
        choose(/** @type {string} */ chosen) {
            name = chosen;
            element.hidden = name !== "brush";
        },
        press(/** @type {PointerEvent} */ event) {
            if (event.isTrusted) overlay.element.setPointerCapture(event.pointerId); // the keyboard has none
            stroke = [[event.offsetX, event.offsetY]];
        },
        draw() {
            if (!stroke.length) return;
            overlay.drawing.save();
            overlay.drawing.globalAlpha = 0.4;
            overlay.drawing.fillStyle = overlay.drawing.strokeStyle = colour("amber");
            trace(overlay.drawing);
            overlay.drawing.restore();
        },
    };
}
