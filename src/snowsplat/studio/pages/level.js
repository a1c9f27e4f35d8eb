// The tool that turns the scene: by three points of a floor, or about an axis.

import { make } from "./page.js";
import { say } from "./text.js";
import { about, levelling } from "./turning.js";

const AXES = ["x", "y", "z"];
const FINE = 15; // degrees to both sides of a slider
const degreesOf = (/** @type {HTMLInputElement} */ slider) => `${Number(slider.value).toFixed(1)}°`;

/** @param {import("./edit.js").Editing} editing */
export function addLevel({ edits, overlay, world, placement, presentView, draw, change, show, tell }) {
    /** @type {number[][]} */
    let floor = []; // at most two points
    const turns = AXES.map((axis, k) => {
        const by = (/** @type {number} */ degrees) =>
            make(
                "button",
                {
                    type: "button",
                    "aria-label": say("edit_turn", axis, degrees),
                    click: change(() => edits.turnBy(about(k, degrees))),
                },
                `${degrees > 0 ? "+" : "−"}90°`,
            );
        const fine = /** @type {HTMLInputElement} */ (
            make("input", {
                type: "range",
                min: -FINE,
                max: FINE,
                step: "any",
                value: 0,
                "aria-label": say("edit_turn_fine", axis),
                input: () => {
                    placement.show(about(k, Number(fine.value)));
                    angle.textContent = degreesOf(fine);
                },
                change: change(() => {
                    if (Number(fine.value)) edits.turnBy(about(k, Number(fine.value)));
                    fine.value = "0";
                    angle.textContent = degreesOf(fine);
                }),
            })
        );
        const angle = make("output", {}, degreesOf(fine));
        return make("div.snow-turn", {}, make("b", {}, axis), by(-90), fine, angle, by(90));
    });
    const told = make("p", { role: "status" });

    function setFloor(/** @type {number[][]} */ points) {
        floor = points;
        told.textContent = points.length ? say("edit_level_points", points.length) : "";
    }

    return {
        element: make("div.snow-level", {}, make("p", {}, say("edit_level_how")), told, ...turns),
        leave: () => setFloor([]),
        /** The third point of a floor makes it level. */
        point(/** @type {number[]} */ point) {
            setFloor([...floor, point]);
            if (floor.length < 3) return draw();
            const turn = levelling(floor.map(placement.placed), presentView().slice(0, 3));
            setFloor([]);
            if (turn) edits.turnBy(turn);
            else tell(say("edit_on_a_line"));
            show();
        },
        draw: () => floor.forEach((point, i) => overlay.mark(world(), placement.placed(point), String(i + 1))),
    };
}
