// The pointer of the keyboard: a cross in the window, which the arrow keys move. Enter presses it and
// releases it again; the tools get the events of a pointer, and need not know about keys.

import { colour } from "./overlay.js";

const STEP = 4; // CSS pixels of an arrow key; ten times as much with Shift
const SIZE = 14; // of the cross, from its middle

/** @type {Record<string, number[]>} */
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/**
 * @param {ReturnType<typeof import("./overlay.js").addOverlay>} overlay
 * @param {() => boolean} drags whether the tool follows the pointer until it is released
 */
export function addCursor({ element, drawing }, drags) {
    let place = [0.5, 0.5]; // as shares of the window
    let isDown = false;
    const size = () => [element.clientWidth, element.clientHeight];
    const send = (/** @type {string} */ kind, /** @type {KeyboardEvent | undefined} */ keys = undefined) => {
        const { left, top } = element.getBoundingClientRect();
        const [clientX, clientY] = size().map((length, k) => [left, top][k] + place[k] * length);
        const { shiftKey = false, altKey = false } = keys ?? {};
        element.dispatchEvent(new PointerEvent(kind, { clientX, clientY, shiftKey, altKey, isPrimary: true }));
    };
    const release = (/** @type {string} */ kind, /** @type {KeyboardEvent | undefined} */ keys = undefined) => {
        if (isDown) send(kind, keys);
        isDown = false;
    };
    element.addEventListener("keydown", event => {
        const way = ARROWS[event.key];
        if (way) {
            const step = event.shiftKey ? 10 * STEP : STEP;
            place = size().map((length, k) => Math.min(1, Math.max(0, place[k] + (step * way[k]) / length)));
            if (isDown) send("pointermove");
        } else if (event.key !== "Enter") return;
        else if (isDown) release("pointerup", event);
        else {
            isDown = drags();
            send("pointerdown", event);
        }
        event.preventDefault();
        event.stopPropagation(); // it is not for the camera
    });
    element.addEventListener("blur", () => release("pointercancel"));
    return {
        draw() {
            if (document.activeElement !== element) return;
            const [x, y] = size().map((length, k) => place[k] * length);
            for (const [style, width] of /** @type {[string, number][]} */ ([
                ["night", 4],
                [isDown ? "coral" : "amber", 2],
            ])) {
                drawing.strokeStyle = colour(style);
                drawing.lineWidth = width;
                drawing.beginPath();
                drawing.moveTo(x - SIZE, y);
                drawing.lineTo(x + SIZE, y);
                drawing.moveTo(x, y - SIZE);
                drawing.lineTo(x, y + SIZE);
                drawing.stroke();
            }
        },
    };
}
