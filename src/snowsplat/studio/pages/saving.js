// What of an edit is saved: title, first view, what the sliders hide. "Save" sends it to the studio.

import { ask, button, make, reasonOf } from "./page.js";
import { say } from "./text.js";

/**
 * @param {import("./edit.js").Editing} editing
 * @param {any} hiding the sliders of the page; see hiding.js
 * @param {string} version of the scene that the page shows
 * @param {() => boolean} isDeleted whether a Gaussian is deleted
 */
export function addSaving({ edits, scene, placement, presentView, change, show, tell }, hiding, version, isDeleted) {
    const { notes: noted } = edits.present;
    let saving = false;
    const hides = /** @type {HTMLInputElement} */ (make("input", { type: "checkbox", change: change(() => {}) }));
    const title = /** @type {HTMLInputElement} */ (
        make("input", {
            type: "text",
            maxlength: 80,
            value: scene.title,
            "aria-label": say("title_label"),
            input: change(() => {}),
        })
    );
    const view = button(
        "edit_start",
        change(() => {
            const seen = presentView();
            edits.change({
                start: [
                    ...placement.unplaced(seen.slice(0, 3)),
                    ...placement.unplaced(seen.slice(3, 6)),
                    seen[6],
                    scene.aspect,
                ],
            });
            tell(say("edit_start_set"));
        }),
    );
    const hidden = () => (hides.checked ? hiding.limits() : null);
    const haveNotesChanged = () => JSON.stringify(edits.present.notes) !== JSON.stringify(noted);
    const isChanged = () => {
        const { start, scale } = edits.present;
        return Boolean(
            start ||
                scale !== 1 ||
                placement.isTurned() ||
                title.value.trim() !== scene.title ||
                isDeleted() ||
                hidden() ||
                haveNotesChanged(),
        );
    };

    /** Sends a change to the studio, and shows the scene as it is then. */
    async function send(/** @type {string} */ method, /** @type {any} */ body) {
        saving = true;
        show();
        tell(say("edit_saving"));
        try {
            await ask(`../edit?version=${version}`, method, body);
            removeEventListener("beforeunload", keep);
            // The page of the studio shows the scene in a frame; it has other figures now, too.
            if (parent === window) location.replace(`../site/index.html${location.search}`);
            else parent.document.dispatchEvent(new Event("edited"));
        } catch (error) {
            tell(reasonOf(error));
            saving = false;
            show();
        }
    }
    const save = button("edit_save", () => {
        const changed = title.value.trim();
        const { state, scale, start, notes, turn } = edits.present;
        if (notes.some(note => !note.title.trim())) return tell(say("edit_note_untitled"));
        send("POST", {
            count: state.length,
            removed: edits.deleted(),
            scale,
            title: changed === scene.title ? "" : changed,
            start,
            hidden: hidden(),
            notes: haveNotesChanged() ? notes : null,
            turn: placement.isTurned() ? turn : null,
        });
    });
    const back = button("edit_back", () => {
        if (confirm(say("edit_back_sure"))) send("DELETE", undefined);
    });
    const keep = (/** @type {Event} */ event) => {
        if (isChanged()) event.preventDefault();
    };
    addEventListener("beforeunload", keep);
    return {
        hides: make("label.snow-check", {}, hides, say("edit_hides")),
        title,
        view,
        save,
        back,
        isSaving: () => saving,
        show: () => (save.disabled = saving || !isChanged()),
    };
}
