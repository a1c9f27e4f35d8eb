// Uploads: those that run, and what a page shows of them.

import { bytes, duration, make } from "./page.js";
import { say } from "./text.js";
import { chosen, Upload } from "./upload.js";

/** @type {Map<string, Upload>} */
export const uploads = new Map();

// An upload ends with the page.
addEventListener("beforeunload", event => {
    if (uploads.size) event.preventDefault();
});

/** Begins to upload files to a scene. */
export function upload(/** @type {string} */ name, /** @type {import("./upload.js").Item[]} */ items) {
    const address = `scenes/${encodeURIComponent(name)}`;
    const started = new Upload(address, items, () => document.dispatchEvent(new Event("uploaded")));
    uploads.set(name, started);
    started.run().then(done => {
        if (done) uploads.delete(name);
        document.dispatchEvent(new Event("uploaded"));
    });
}

/** The progress of an upload. */
export function sendingPart(/** @type {import("./scene.js").ScenePage} */ page) {
    const bar = make("progress", { max: 1, "aria-label": say("files", "", "") });
    const line = make("p");
    const more = moreFiles(page);
    page.update = () => {
        const sending = uploads.get(page.name);
        if (!sending) return;
        const now = sending.bytes;
        bar.setAttribute("value", String(sending.total ? now / sending.total : 1));
        const left = now > sending.before ? ` – ${say("left", duration(sending.left))}` : "";
        const text = `${say("files", sending.finished, sending.items.length)}, ${say("uploading", bytes(now), bytes(sending.total))}${left}`;
        line.textContent = sending.error || (sending.offline ? say("offline") : text);
        line.classList.toggle("bad", Boolean(sending.error));
        more.hidden = !sending.error;
    };
    return [make("section.card", {}, bar, line, more)];
}

/** A button that adds files to a scene. */
export function moreFiles(/** @type {import("./scene.js").ScenePage} */ page) {
    const input = make("input", {
        type: "file",
        multiple: true,
        change: (/** @type {Event & {target: HTMLInputElement}} */ event) => add(page, event.target.files),
    });
    return make("p", {}, make("label.button.plain", {}, say("add_files"), input));
}

function add(/** @type {import("./scene.js").ScenePage} */ page, /** @type {FileList | null} */ files) {
    if (files?.length) upload(page.name, chosen(files));
}
