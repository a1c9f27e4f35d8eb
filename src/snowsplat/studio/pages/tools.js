// Tools in the page of a finished scene. The studio adds this module to the page, whose script
// (panel.js) calls `window.sse.tools` before the scene has loaded.

import { addEditor, centersOf } from "./edit.js";
import { addFilm } from "./film.js";
import { chosenLanguage, speak } from "./text.js";

const { whole, edited } = /** @type {HTMLElement} */ (document.querySelector("script[data-whole]")).dataset;

function addTools(/** @type {any} */ page) {
    const { app, events, state } = page.viewer;
    /** @type {any} */
    let picker;
    events.once("picker:ready", (/** @type {any} */ ready) => (picker = ready));
    const begin = async () => {
        addFilm(page);
        // Levels of detail cannot be edited.
        if (whole === "true") addEditor(page, picker, await centersOf(app), edited === "true");
    };
    if (state.loaded) begin();
    else events.once("loaded:changed", begin);
}

speak(chosenLanguage());
/** @type {any} */ (window).sse.tools = addTools;
