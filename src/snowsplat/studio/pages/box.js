// The box of the editor: a handle in the middle of each face, which is dragged or moved by the arrow keys,
// and a slider for each face. Its coordinates are those of the page, whose y axis points up.

import { button, make } from "./page.js";
import { along, bounds, outside, project } from "./selection.js";
import { say } from "./text.js";
import { lengthOf } from "./units.js";

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
const ROOM = 1.3; // times the radius of the subject, which the window shows with the box
const BEYOND = 0.5; // of the first box, to both sides of it: the range of a slider

/**
 * The first box, around the subject: its lower and its upper corner.
 * @param {Float32Array} centers
 * @param {number[]} subject its middle and its radius
 */
export function boxAround(centers, [x, y, z, radius]) {
    const corners = bounds(centers).map(corner => corner.map((value, k) => SIGNS[k] * value));
    const all = [0, 1].map(side => AXES.map((_, k) => Math[side ? "max" : "min"](corners[0][k], corners[1][k])));
    const around = [-radius, radius].map(by => [x + by, y + by, z + by]);
    const [low, high] = AXES.map((_, k) => [
        Math.max(all[0][k], around[0][k]),
        Math.min(all[1][k], around[1][k]),
    ]).reduce(
        ([a, b], [from, to]) => [
            [...a, from],
            [...b, to],
        ],
        /** @type {number[][]} */ ([[], []]),
    );
    return low.every((value, k) => value < high[k]) ? [low, high] : all;
}

/** @param {import("./edit.js").Editing} editing */
export function addBox({ edits, scene, centers, canvas, overlay, model, select, show, frame }) {
    let sides = edits.present.box;
    let framed = false; // whether it was shown
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
        const number = make("output");
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
            handle.ariaValueText = number.textContent = lengthOf({ edits, scene }, value);
        }
        show();
        return { axis, side, handle, slider, number, show };
    }

    const seen = (/** @type {number} */ side, /** @type {number} */ axis) =>
        project(model(), middle(side, axis), canvas.clientWidth, canvas.clientHeight);

    /** Whether the middle of each face is in the window. */
    const isInWindow = () =>
        faces.every(({ axis, side }) => {
            const [x, y, depth] = seen(side, axis);
            return depth > 0 && x > 0 && y > 0 && x < canvas.clientWidth && y < canvas.clientHeight;
        });

    /** Puts the handles to their places in the window; those behind the camera are hidden. */
    function place() {
        for (const { axis, side, handle } of faces) {
            const [x, y, depth] = seen(side, axis);
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
            ...faces.filter(face => face.axis === k).flatMap(face => [face.slider, face.number]),
        ),
    );
    return {
        element: make("div", {}, ...sliders, button("edit_outside", selectOutside)),
        choose() {
            handles.hidden = false;
            if (!framed && !isInWindow()) frame(ROOM);
            framed = true;
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
