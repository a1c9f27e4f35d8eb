// The tool that writes annotations.

import { button, make } from "./page.js";
import { say } from "./text.js";

const MOST = 25; // the limit of the viewer

/**
 * The annotations of the viewer.
 * @param {any} page see panel.js
 * @returns {import("./edits.js").Note[]}
 */
export function notesOf({ viewer, scene }) {
    return viewer.annotations.map((/** @type {any} */ { title, text, camera: { initial } }) => ({
        title,
        text,
        view: [...initial.position, ...initial.target, initial.fov, scene.aspect],
    }));
}

/** @param {import("./edit.js").Editing} editing */
export function addNotes({ edits, scene, overlay, world, placement, presentView, change, show, tell }) {
    /** @type {import("./edits.js").Note[]} */
    let listed = [];
    const list = make("div");

    function write() {
        listed = edits.present.notes;
        const replaced = (/** @type {number} */ i, /** @type {any} */ changes) =>
            edits.present.notes.map((note, k) => (k === i ? { ...note, ...changes } : note));
        const field = (/** @type {number} */ i, /** @type {"title" | "text"} */ key, /** @type {number} */ most) =>
            make("input", {
                type: "text",
                maxlength: most,
                value: listed[i][key],
                "aria-label": say(`edit_note_${key}`),
                placeholder: say(`edit_note_${key}`),
                input: change((/** @type {any} */ event) => {
                    edits.change({ notes: replaced(i, { [key]: event.target.value }) }, `${key} ${i}`);
                    listed = edits.present.notes; // the field has the text already
                }),
            });
        const drop = (/** @type {number} */ i) =>
            change(() => edits.change({ notes: edits.present.notes.filter((_, k) => k !== i) }));
        list.replaceChildren(
            ...listed.map((_, i) =>
                make(
                    "div.snow-buttons",
                    {},
                    make("b", {}, String(i + 1)),
                    field(i, "title", 60),
                    field(i, "text", 280),
                    button("film_remove", drop(i)),
                ),
            ),
        );
    }

    return {
        element: make("div", {}, make("p", {}, say("edit_note_how")), list),
        show() {
            if (listed !== edits.present.notes) write();
        },
        point(/** @type {number[]} */ point) {
            const { notes } = edits.present;
            if (notes.length >= MOST) return tell(say("edit_notes_most", MOST));
            const view = presentView();
            const note = {
                title: say("edit_note_new", notes.length + 1),
                text: "",
                view: [...placement.unplaced(view.slice(0, 3)), ...point, view[6], scene.aspect],
            };
            edits.change({ notes: [...notes, note] });
            show();
        },
        draw: () =>
            listed.forEach(({ view }, i) => overlay.mark(world(), placement.placed(view.slice(3, 6)), String(i + 1))),
    };
}
