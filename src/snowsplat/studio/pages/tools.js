// Tools in the page of a finished scene. The studio adds this module to the page, whose script
// (panel.js) calls `window.sse.tools` before the scene has loaded.

import { addEditor, centersOf } from "./edit.js";
import { addFilm } from "./film.js";
import { ask, make, reasonOf } from "./page.js";
import { chosenLanguage, say, speak } from "./text.js";

const {
    page: kind,
    edited,
    version,
} = /** @type {HTMLElement} */ (document.querySelector("script[data-page]")).dataset;

const NARROW = 600; // CSS pixels, as in tools.css

function addTools(/** @type {any} */ page) {
    const { app, events, state } = page.viewer;
    /** @type {any} */
    let picker;
    events.once("picker:ready", (/** @type {any} */ ready) => (picker = ready));
    // The page fades its panel when its controls hide. It stays where there is room for it, and with a tool.
    events.on("controlsHidden:changed", () => {
        const isOpen = page.panel.querySelector(".snow-tools:not([hidden])") !== null;
        if (isOpen || innerWidth >= NARROW) page.panel.classList.remove("snow-faded");
    });
    const keep = (/** @type {string} */ address) => {
        /** @type {any} */ (window).sse.look = address;
    };
    lookAddress().then(keep, () => {}); // without it, the link is that of the page
    const begin = async () => {
        const others = new Set(page.panel.querySelectorAll("button"));
        addFilm(page, version ?? "");
        if (kind === "levels") addWholePage(page.panel);
        else addEditor(page, picker, await centersOf(app), version ?? "", edited === "true", kind === "whole");
        oneAtATime([...page.panel.querySelectorAll("button[aria-expanded]")].filter(each => !others.has(each)));
    };
    if (state.loaded) begin();
    else events.once("loaded:changed", begin);
}

/** The address at which this scene can only be looked at. */
async function lookAddress() {
    const path = [...location.pathname.split("/").slice(-4, -2), "site", "index.html"].join("/");
    const { look } = await ask(`../../../about?path=${encodeURIComponent(path)}`);
    return new URL(look, new URL("../../../", location.href)).href;
}

/** Film and Edit have the same place, so opening one closes the other. */
function oneAtATime(/** @type {HTMLElement[]} */ openers) {
    for (const opener of openers)
        opener.addEventListener("click", () => {
            if (opener.ariaExpanded !== "true") return;
            for (const other of openers) if (other !== opener && other.ariaExpanded === "true") other.click();
        });
}

/** Levels of detail have parts of the scene only. A button writes a page with the whole scene. */
function addWholePage(/** @type {HTMLElement} */ panel) {
    const told = make("p", { role: "status" });
    const open = /** @type {HTMLButtonElement} */ (make("button", { type: "button" }, say("edit")));
    open.addEventListener("click", async () => {
        open.disabled = true;
        told.textContent = say("edit_whole");
        try {
            await ask("../whole", "POST");
            location.href = `../whole/index.html${location.search}`;
        } catch (error) {
            told.textContent = reasonOf(error);
            open.disabled = false;
        }
    });
    panel.querySelector(".snow-copied")?.before(open);
    panel.querySelector(".snow-card")?.append(told);
}

speak(chosenLanguage());
/** @type {any} */ (window).sse.tools = addTools;
