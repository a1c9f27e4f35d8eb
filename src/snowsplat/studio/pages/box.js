// The box of the editor: a handle in the middle of each face, which is dragged or moved by the arrow keys,
// and a slider for each face. Its coordinates are those of the page, whose y axis points up.

import { button, make } from "./page.js";
import { along, bounds, outside, project } from "./selection.js";
import { say } from "./text.js";

const AXES = ["x", "y", "z"];
const SIGNS = [-1, -1, 1]; // of the axes of the scene: the viewer has turned it by 180° about z
const ARROWS = new Map([
    ["ArrowRight", 1],
    ["ArrowUp", 1],
    ["ArrowLeft", -1],
    ["ArrowDown", -1],
]);
const STEP = 0.01; // of an arrow key, as a share of the first box; ten times as much with Shift
const PAUSE = 1000; // milliseconds without a key, after which the next one begins another step
const BEYOND = 0.5; // of the first box, to both sides of it: the range of a slider

/** The first box: its lower and its upper corner. */
export function boxAround(/** @type {Float32Array} */ centers) {
    const corners = bounds(centers).map(corner => corner.map((value, k) => SIGNS[k] * value));
    return [0, 1].map(side => AXES.map((_, k) => Math[side ? "max" : "min"](corners[0][k], corners[1][k])));
}

/** @param {import("./edit.js").Editing} editing */
export function addBox({ edits, centers, canvas, overlay, model, select, show }) {
    let sides = edits.present.box;
    const spans = AXES.map((_, k) => sides[1][k] - sides[0][k]);
    const inScene = (/** @type {number[]} */ point) => point.map((value, k) => SIGNS[k] * value);
    const middle = (/** @type {number} */ side, /** @type {number} */ axis) =>
        inScene(AXES.map((_, k) => (k === axis ? sides[side][k] : (sides[0][k] + sides[1][k]) / 2)));
    // A drag, or keys without a pause between them, are one step that can be undone.
    let step = 0;
    let pressed = -Infinity; // the time of the last key
    /** @type {EventTarget | null} */
    let focused = null; // its face

    /** Moves a face; it takes the opposite one with it. */
    function move(/** @type {number} */ side, /** @type {number} */ axis, /** @type {number} */ value) {
        if (value === sides[side][axis]) return;
        const next = sides.map(corner => [...corner]);
        next[side][axis] = value;
        next[1 - side][axis] = Math[side ? "min" : "max"](next[1 - side][axis], value);
        edits.change({ box: next }, `box ${step}`);
        show();
    }

    /** A key begins a step after a pause, or on another face. */
    function begin(/** @type {KeyboardEvent} */ event) {
        if (event.timeStamp - pressed > PAUSE || event.target !== focused) step++;
        pressed = event.timeStamp;
        focused = event.target;
    }

    const faces = AXES.flatMap((name, axis) => [0, 1].map(side => addFace(name, axis, side)));

    function addFace(/** @type {string} */ name, /** @type {number} */ axis, /** @type {number} */ side) {
        const label = say(side ? "edit_to" : "edit_from", name);
        const first = sides[side][axis];
        const slider = /** @type {HTMLInputElement} */ (
            make("input", {
                type: "range",
                step: "any",
                "aria-label": label,
                title: label,
                input: () => move(side, axis, Number(slider.value)),
                pointerdown: () => step++,
                keydown: begin,
            })
        );
        slider.min = String(first - (side ? 1 : BEYOND) * spans[axis]);
        slider.max = String(first + (side ? BEYOND : 1) * spans[axis]);
        const handle = make(
            "div.snow-handle",
            { role: "slider", tabindex: 0, "aria-label": label, "data-axis": name },
            name,
        );
        /** @type {{from: number, place: number[], point: number[]} | null} */
        let held = null;
        handle.addEventListener("pointerdown", event => {
            if (!event.isPrimary || event.button) return;
            event.stopPropagation(); // it is not for the camera
            handle.setPointerCapture(event.pointerId);
            step++;
            held = {
                from: sides[side][axis],
                place: [event.clientX, event.clientY],
                point: middle(side, axis),
            };
        });
        handle.addEventListener("pointermove", event => {
            if (!held || !event.isPrimary) return;
            const { clientWidth: width, clientHeight: height } = canvas;
            const [x, y] = project(model(), held.point, width, height);
            const place = [x + event.clientX - held.place[0], y + event.clientY - held.place[1]];
            const moved = along(model(), held.point, axis, spans[axis], place, width, height);
            if (moved !== null) move(side, axis, held.from + SIGNS[axis] * moved);
        });
        for (const end of ["pointerup", "pointercancel"]) handle.addEventListener(end, () => (held = null));
        handle.addEventListener("keydown", event => {
            const way = ARROWS.get(event.key);
            if (!way) return;
            event.preventDefault();
            begin(event);
            move(side, axis, sides[side][axis] + way * STEP * (event.shiftKey ? 10 : 1) * spans[axis]);
        });
        // They are not for the camera.
        for (const kind of ["keydown", "keyup"])
            handle.addEventListener(
                kind,
                event => ARROWS.has(/** @type {KeyboardEvent} */ (event).key) && event.stopPropagation(),
            );
        function show() {
            const value = sides[side][axis];
            slider.value = String(value);
            handle.ariaValueNow = String(value);
            handle.ariaValueText = value.toPrecision(3);
        }
        show();
        return { axis, side, handle, slider, show };
    }

    /** Puts the handles to their places in the window; those behind the camera are hidden. */
    function place() {
        for (const { axis, side, handle } of faces) {
            const [x, y, depth] = project(model(), middle(side, axis), canvas.clientWidth, canvas.clientHeight);
            handle.hidden = depth <= 0;
            handle.style.transform = `translate(${x}px, ${y}px) translate(-50%, -50%)`;
            handle.style.zIndex = String(Math.round(1e5 / (1 + Math.max(depth, 0))));
        }
    }

    /** The twelve edges in the space of the centres, in short pieces, since those behind the camera are not drawn. */
    function edges() {
        const pieces = 16;
        return AXES.flatMap((_, axis) =>
            [0, 1, 2, 3].flatMap(edge => {
                const ends = AXES.map((_, k) => (edge >> Number((k + 3 - axis) % 3 === 1)) & 1);
                const point = (/** @type {number} */ share) =>
                    inScene(
                        AXES.map((_, k) =>
                            k === axis ? sides[0][k] + share * (sides[1][k] - sides[0][k]) : sides[ends[k]][k],
                        ),
                    );
                return Array.from({ length: pieces }, (_, i) => [point(i / pieces), point((i + 1) / pieces)]);
            }),
        );
    }

    function selectOutside() {
        const [a, b] = sides.map(inScene);
        select(
            outside(
                centers,
                AXES.map((_, k) => Math.min(a[k], b[k])),
                AXES.map((_, k) => Math.max(a[k], b[k])),
            ),
        );
    }

    const handles = make("div.snow-handles", { hidden: true }, ...faces.map(face => face.handle));
    overlay.element.after(handles);
    const sliders = AXES.map((name, k) =>
        make(
            "div.snow-sides",
            {},
            make("b", {}, name),
            ...faces.filter(face => face.axis === k).map(face => face.slider),
        ),
    );
    return {
        element: make("div", {}, make("p", {}, say("edit_box_how")), ...sliders, button("edit_outside", selectOutside)),
        choose() {
            handles.hidden = false;
        },
        leave() {
            handles.hidden = true;
        },
        show() {
            if (sides === edits.present.box) return;
            sides = edits.present.box;
            for (const face of faces) face.show();
        },
        draw() {
            overlay.lines(model(), edges());
            place();
        },
    };
}
