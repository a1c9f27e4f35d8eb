// The tool that measures the distance of two points, and scales the scene by a known distance.

import { button, make } from "./page.js";
import { say } from "./text.js";
import { lengthOf } from "./units.js";

/** @param {import("./edit.js").Editing} editing */
export function addRuler({ edits, scene, overlay, world, placement, draw, show }) {
    /** @type {number[][]} */
    let measured = []; // at most two points
    const told = make("span", { role: "status" }, say("edit_two_points"));
    const truth = /** @type {HTMLInputElement} */ (
        make("input", {
            type: "number",
            min: 0,
            step: "any",
            "aria-label": say("edit_truth"),
            placeholder: say("edit_truth"),
        })
    );
    const rescale = button("edit_rescale", () => {
        const wanted = Number(truth.value);
        if (!(wanted > 0)) return truth.focus();
        edits.change({ scale: (wanted * scene.scale) / distance() });
        show();
    });
    const size = make("span");

    /** The measured distance in units of the page; 0 if there is none. */
    function distance() {
        if (measured.length < 2) return 0;
        const [a, b] = measured;
        return Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
    }

    function tell() {
        const { scale } = edits.present;
        const found = distance();
        told.textContent = found ? say("edit_distance", lengthOf({ edits, scene }, found, 4)) : say("edit_two_points");
        rescale.disabled = !found;
        size.textContent = scale === 1 ? "" : say("edit_size", scale.toPrecision(4));
    }

    return {
        element: make("div.snow-buttons", {}, told, truth, rescale, size),
        show: tell,
        point(/** @type {number[]} */ point) {
            measured = [...(measured.length === 2 ? [] : measured), point];
            tell();
            draw();
        },
        draw() {
            const points = measured.map(placement.placed);
            overlay.lines(world(), points.length === 2 ? [points] : []);
            for (const point of points) overlay.mark(world(), point, "");
        },
    };
}
