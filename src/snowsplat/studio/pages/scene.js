// The page of one scene: uploads, what the photos are, the progress of the job, and the result.

import { action, ask, make, notice, reasonOf, showStatus } from "./page.js";
import { progressPart, stoppedPart } from "./scene_progress.js";
import { resultPart } from "./scene_result.js";
import { startPart } from "./scene_start.js";
import { sendingPart, upload, uploads } from "./scene_upload.js";
import { say } from "./text.js";
import { dropped } from "./upload.js";

/** @typedef {import("./types.js").Scene} Scene */
/** @typedef {(page: ScenePage, scene: Scene) => (Node | false)[]} Part */

/** @type {Record<string, Part>} */
const PARTS = {
    upload: sendingPart,
    new: startPart,
    running: progressPart,
    done: resultPart,
    found: openingPart,
    opening: openingPart,
};
const WITHOUT_NAME = ["upload", "running", "found", "opening"];

/** Shows a scene in an element, until `closed` is aborted. */
export class ScenePage {
    uploaded = false; // whether its photos are uploaded, not in a folder of the machine
    shown = ""; // the status whose parts are shown
    body = make("div");
    /** @type {((scene: Scene) => void) | undefined} */
    update; // brings the parts up to date
    #away = false; // whether the server did not answer
    #title = make("h1");
    #status = make("p.status", { role: "status" });
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    #timer;

    /**
     * @param {HTMLElement} main
     * @param {string} name
     * @param {AbortSignal} closed
     */
    constructor(main, name, closed) {
        this.name = name;
        this.closed = closed;
        this.address = `scenes/${encodeURIComponent(name)}`;
        const back = make("p", {}, make("a", { href: "#" }, `← ${say("back")}`));
        main.replaceChildren(back, this.#title, this.#status, this.body);
        main.addEventListener("dragover", event => event.preventDefault(), { signal: closed });
        main.addEventListener("drop", event => this.#drop(event), { signal: closed });
        document.addEventListener("uploaded", () => this.#uploadChanged(), { signal: closed });
        document.addEventListener("edited", () => this.showAnew(), { signal: closed });
        closed.addEventListener("abort", () => clearTimeout(this.#timer));
        this.refresh();
    }

    /** Asks the server, and shows what is new. */
    async refresh() {
        clearTimeout(this.#timer);
        let wait = 1000;
        try {
            const scene = await ask(this.address);
            if (this.closed.aborted) return;
            if (this.#away) notice("");
            this.#away = false;
            this.#show(scene);
            if (scene.status !== "running") wait = 4000;
        } catch (error) {
            if (this.closed.aborted) return;
            this.#away = true;
            notice(reasonOf(error));
            wait = 3000;
        }
        this.#timer = setTimeout(() => this.refresh(), wait);
    }

    /** Makes all parts anew. */
    showAnew() {
        this.shown = "";
        return this.refresh();
    }

    #show(/** @type {Scene} */ scene) {
        this.#title.textContent = document.title = scene.title;
        const sending = uploads.has(this.name);
        showStatus(this.#status, scene.status, scene.verdict?.grade);
        this.#status.hidden = sending;
        this.uploaded = scene.inputs.length === 0 && !scene.found;
        const parts = sending ? "upload" : scene.status;
        if (parts !== this.shown) {
            this.shown = parts;
            this.update = undefined;
            const part = PARTS[parts] ?? stoppedPart;
            const kept = WITHOUT_NAME.includes(parts) ? [] : [keptPart(this, scene)];
            const hadFocus = this.body.contains(document.activeElement);
            this.body.replaceChildren(...part(this, scene).filter(each => each !== false), ...kept);
            if (hadFocus) document.getElementById("main")?.focus({ preventScroll: true });
        }
        this.update?.(scene);
    }

    #uploadChanged() {
        // Only the upload is shown: its progress needs no scene.
        if (uploads.has(this.name) && this.shown === "upload") this.update?.(/** @type {Scene} */ ({}));
        else this.refresh();
    }

    async #drop(/** @type {DragEvent} */ event) {
        event.preventDefault();
        const isFree = this.shown !== "running" && (this.shown !== "upload" || uploads.get(this.name)?.error);
        if (!event.dataTransfer || !this.uploaded || !isFree) return;
        const items = await dropped(event.dataTransfer);
        if (items.length) upload(this.name, items);
    }
}

/** A scene of the command line has no site yet; that of another one is not written. */
function openingPart(
    /** @type {import("./scene.js").ScenePage} */ page,
    /** @type {import("./types.js").Scene} */ scene,
) {
    const line = make("p", { role: "status" }, say("opening"));
    const tell = (/** @type {unknown} */ error) => {
        line.textContent = reasonOf(error);
        page.body.append(keptPart(page, scene)); // a scene that cannot be opened can be removed
    };
    ask(`${page.address}/open`, "POST", {}).then(() => page.refresh(), tell);
    return [make("section.card", {}, line)];
}

/** Its name, its folder, and how to remove it. */
function keptPart(/** @type {import("./scene.js").ScenePage} */ page, /** @type {import("./types.js").Scene} */ scene) {
    const name = /** @type {HTMLInputElement} */ (
        make("input", {
            type: "text",
            value: scene.title,
            maxlength: 80,
            "aria-label": say("title_label"),
        })
    );
    const rename = async () => {
        await ask(`${page.address}/rename`, "POST", { title: name.value });
        await page.showAnew();
    };
    const remove = async () => {
        if (!confirm(say("remove_sure", scene.title))) return;
        const { photos } = await ask(page.address, "DELETE");
        location.hash = "";
        // The other page hides notices when it begins.
        setTimeout(() => notice(photos ? say("removed_but", photos) : say("removed")));
    };
    return make(
        "section.card",
        {},
        // The form that starts the job has the name, too.
        scene.status === "done" &&
            make("form.row", {}, name, make("button.plain", { type: "submit", click: action(rename) }, say("rename"))),
        make("p.soft", {}, say("kept_at", scene.folder)),
        !scene.found &&
            make(
                "div.row",
                {},
                make("button.plain", { type: "button", click: action(remove) }, say("remove")),
                make("span.soft", {}, say("remove_help")),
            ),
    );
}
