// The editor in the page of a finished scene; see tools.js. Each of its tools has a file of its own. The
// scene is changed in `Edits`, and everything is shown from there.

import { addBox, boxAround } from "./box.js";
import { DELETED, Edits, SELECTED } from "./edits.js";
import { addLevel } from "./level.js";
import { addNotes, notesOf } from "./notes.js";
import { addOverlay } from "./overlay.js";
import { addCursor } from "./cursor.js";
import { icon } from "./icons.js";
import { button, make } from "./page.js";
import { painter } from "./painting.js";
import { addPlacement } from "./placement.js";
import { addRuler } from "./ruler.js";
import { addSaving } from "./saving.js";
import { times } from "./selection.js";
import { addShapes } from "./shapes.js";
import { say } from "./text.js";
import { UNTURNED } from "./turning.js";

/** The keys of the tools; those of the viewer are others. */
const KEYS = /** @type {Record<string, string>} */ ({
    rectangle: "M",
    lasso: "L",
    brush: "B",
    box: "C",
    measure: "T",
    note: "N",
    level: "U",
    delete: "Del",
    undo: "Ctrl Z",
    redo: "Ctrl Y",
});
const SELECTING = 4; // the first tools select
const LETTERS = new Map(
    Object.entries(KEYS)
        .filter(([, key]) => key.length === 1)
        .map(([name, key]) => [key.toLowerCase(), name]),
);

/** A button with an icon and its key. */
function keyButton(/** @type {string} */ name, /** @type {(event: any) => void} */ click) {
    const made = button(`edit_${name}`, click);
    made.classList.add("snow-tool");
    made.prepend(icon(name));
    made.dataset.key = KEYS[name];
    made.setAttribute("aria-keyshortcuts", KEYS[name].replace("Del", "Delete").replace("Ctrl ", "Control+"));
    return made;
}

/** Buttons with a common label. */
const group = (/** @type {string} */ label, /** @type {HTMLElement[]} */ ...buttons) =>
    make(
        "div.snow-group",
        { role: "group", "aria-label": say(label) },
        make("small", {}, say(label)),
        make("div.snow-buttons", {}, ...buttons),
    );

/**
 * A tool for the window.
 * @typedef {object} Tool
 * @property {HTMLElement} element its part of the panel
 * @property {(name: string) => void} [choose] called when it was chosen
 * @property {() => void} [leave] called when it is not chosen
 * @property {() => void} [show] shows the edit as it is now
 * @property {() => void} [draw] draws in the window while it is chosen
 * @property {(event: PointerEvent) => void} [press] called when the pointer is pressed in the window; or:
 * @property {(point: number[]) => void} [point] called with a point of the surface that was clicked
 */

/**
 * What the tools share. `model` and `world` are the clip space from the space of the centres and from
 * the world; `show` shows everything, `draw` what is drawn in the window only; `change` makes a listener
 * that changes something; `select` takes a byte per Gaussian and the event with the keys that are held.
 * @typedef {object} Editing
 * @property {Edits} edits
 * @property {Float32Array} centers
 * @property {any} scene
 * @property {HTMLCanvasElement} canvas
 * @property {(times: number) => void} frame shows so many times the radius of the subject
 * @property {() => number[]} presentView
 * @property {ReturnType<typeof addOverlay>} overlay
 * @property {ReturnType<typeof addPlacement>} placement
 * @property {() => Float64Array} model
 * @property {() => Float64Array} world
 * @property {() => void} show
 * @property {() => void} draw
 * @property {(run: (event?: any) => void) => (event?: any) => void} change
 * @property {(text: string) => void} tell
 * @property {(found: Uint8Array, keys?: {shiftKey: boolean, altKey: boolean}) => void} select
 */

/** The centres of the Gaussians (N, 3), when the scene has loaded. */
export async function centersOf(/** @type {any} */ app) {
    const { resource } = app.assets.get(app.root.findByName("gsplat").gsplat.asset);
    if (resource.centers) return resource.centers;
    await resource.gsplatData.generateCenters();
    return resource.gsplatData.getCenters();
}

/**
 * @param {any} page see panel.js
 * @param {any} picker of the viewer: finds the surface at a place of the window
 * @param {Float32Array} centers (N, 3)
 * @param {string} version of the scene that the page shows
 * @param {boolean} isEdited whether the scene was edited before
 * @param {boolean} isWhole whether the page is only for editing; another one shows levels of detail
 */
export function addEditor(page, picker, centers, version, isEdited, isWhole) {
    const { viewer, scene, camera, canvas, hiding, panel, presentView, frame } = page;
    const { app } = viewer;
    const entity = app.root.findByName("gsplat");
    const edits = new Edits(centers.length / 3, notesOf(page), boxAround(centers, scene.subject));
    const placement = addPlacement(page, edits);
    const overlay = addOverlay(canvas);
    const told = make("p", { role: "status" });
    const tell = (/** @type {string} */ text) => {
        told.textContent = text;
    };

    // What is shown

    const paint = painter(app, hiding);
    let painted = edits.present.state;
    let marked = [centers.length / 3, 0, 0];
    function show() {
        const { state } = edits.present;
        placement.show(UNTURNED);
        if (painted !== state) {
            paint((painted = state));
            marked = edits.counts();
        }
        counts.textContent = say("edit_counts", marked[SELECTED].toLocaleString(), marked[DELETED].toLocaleString());
        remove.disabled = !marked[SELECTED];
        undo.disabled = !edits.past.length;
        redo.disabled = !edits.future.length;
        for (const each of tools.values()) each.show?.();
        saving.show();
        draw();
        app.renderNextFrame = true;
    }
    function draw() {
        overlay.clear();
        tools.get(tool)?.draw?.();
        cursor.draw();
    }
    const change =
        (/** @type {(event?: any) => void} */ run) =>
        (/** @type {any} */ event = undefined) => {
            run(event);
            show();
        };
    app.on("update", () => {
        if (!overlay.element.hidden) draw();
    });

    // The tools

    const choices = (/** @type {string[]} */ names, /** @type {(name: string, isKey: boolean) => void} */ choose) => {
        const buttons = names.map(name => {
            const click = (/** @type {MouseEvent} */ event) => choose(name, event.detail === 0);
            return name in KEYS ? keyButton(name, click) : button(`edit_${name}`, click);
        });
        const mark = (/** @type {string} */ chosen) =>
            buttons.forEach((each, i) => (each.ariaPressed = String(names[i] === chosen)));
        return { buttons, mark };
    };
    let tool = "";
    let mode = "replace";
    const modes = choices(["replace", "add", "remove"], name => modes.mark((mode = name)));
    const forSelection = group(
        "edit_mode",
        ...modes.buttons,
        button(
            "edit_invert",
            change(() => edits.invert()),
        ),
    );
    const world = () => times(camera.projectionMatrix.data, camera.viewMatrix.data);
    /** @type {Editing} */
    const editing = {
        edits,
        centers,
        scene,
        canvas,
        frame,
        presentView,
        overlay,
        placement,
        world,
        show,
        draw,
        change,
        tell,
        model: () => times(world(), entity.getWorldTransform().data),
        select(found, keys) {
            edits.select(found, keys?.shiftKey ? "add" : keys?.altKey ? "remove" : mode);
            show();
        },
    };
    const shapes = addShapes(editing);
    /** @type {Map<string, Tool>} */
    const tools = new Map(
        Object.entries({
            rectangle: shapes,
            lasso: shapes,
            brush: shapes,
            box: addBox(editing),
            measure: addRuler(editing),
            note: addNotes(editing),
            level: addLevel(editing),
        }),
    );
    const forTools = new Set(tools.values());
    const cursor = addCursor(overlay, () => Boolean(tools.get(tool)?.press));
    const toolButtons = choices([...tools.keys()], (name, isKey) => choose(tool === name ? "" : name, isKey));
    /** `isKey`: without a mouse; the arrow keys then move a cross, see cursor.js. */
    function choose(/** @type {string} */ name, isKey = false) {
        const last = [...tools.keys()].indexOf(tool);
        const hadFocus = document.activeElement === overlay.element;
        const chosen = tools.get((tool = name));
        toolButtons.mark(name);
        overlay.element.hidden = !name;
        // Without a use for the pointer, it moves the camera.
        const usesPointer = Boolean(chosen?.press || chosen?.point);
        overlay.element.style.pointerEvents = usesPointer ? "auto" : "none";
        overlay.element.tabIndex = usesPointer ? 0 : -1;
        if (usesPointer && isKey) overlay.element.focus();
        else if (hadFocus) toolButtons.buttons[last]?.focus();
        forSelection.hidden = ["measure", "note", "level"].includes(name);
        for (const each of forTools) {
            each.element.hidden = each !== chosen;
            each.leave?.();
        }
        chosen?.choose?.(name);
    }

    overlay.element.addEventListener("pointerdown", async event => {
        const chosen = tools.get(tool);
        if (!event.isPrimary || event.button || !chosen) return;
        event.preventDefault();
        if (!chosen.point) return chosen.press?.(event);
        const found = await picker?.pickSurface(
            event.offsetX / canvas.clientWidth,
            event.offsetY / canvas.clientHeight,
        );
        tell(found ? "" : say("edit_no_surface"));
        if (found) chosen.point(placement.unplaced([found.position.x, found.position.y, found.position.z]));
    });

    // The panel

    const remove = keyButton(
        "delete",
        change(() => edits.delete()),
    );
    const undo = keyButton(
        "undo",
        change(() => go("undo")),
    );
    const redo = keyButton(
        "redo",
        change(() => go("redo")),
    );
    function go(/** @type {"undo" | "redo"} */ way) {
        const { box } = edits.present;
        edits[way]();
        if (edits.present.box !== box && tool !== "box") choose("box"); // what is undone is seen
        tell("");
    }
    const counts = make("p", { role: "status" });
    const saving = addSaving(editing, hiding, version, () => marked[DELETED] > 0);
    const row = (/** @type {(Node | false)[]} */ ...parts) => make("div.snow-buttons", {}, ...parts);
    const content = make(
        "div.snow-edit.snow-tools.snow-card",
        { hidden: true },
        group("edit_select", ...toolButtons.buttons.slice(0, SELECTING)),
        forSelection,
        group("edit_scene", ...toolButtons.buttons.slice(SELECTING)),
        ...[...forTools].map(each => each.element),
        saving.hides,
        row(remove, undo, redo),
        counts,
        row(saving.title, saving.view),
        row(saving.save, isEdited && saving.back),
        told,
        make(
            "details",
            {},
            make("summary", {}, say("edit_help")),
            ...["edit_first", "edit_keys", "edit_box_how"].map(key => make("p", {}, say(key))),
        ),
    );
    const open = button("edit", () => {
        content.hidden = !content.hidden;
        panel.classList.remove("snow-faded");
        open.ariaExpanded = String(!content.hidden);
        if (content.hidden) choose("");
    });
    open.ariaExpanded = "false";
    panel.querySelector(".snow-copied").before(open);
    panel.querySelector(".snow-card").after(content);
    // The sliders change what is saved.
    hiding.element.addEventListener("input", show);
    choose("");
    modes.mark(mode);
    show();
    if (isWhole) open.click();

    const isField = (/** @type {Event} */ event) =>
        event.target instanceof HTMLInputElement && ["text", "number"].includes(event.target.type);
    // Keys in fields are not for the camera.
    for (const kind of ["keydown", "keyup"])
        content.addEventListener(kind, event => {
            if (isField(event)) event.stopPropagation();
        });
    addEventListener(
        "keydown",
        event => {
            if (content.hidden || saving.isSaving() || isField(event)) return;
            const command = event.ctrlKey || event.metaKey;
            const key = event.key.toLowerCase();
            if (command && key === "z") change(() => go(event.shiftKey ? "redo" : "undo"))();
            else if (command && key === "y") change(() => go("redo"))();
            else if (key === "delete" || key === "backspace") change(() => edits.delete())();
            else if (key === "escape" && tool) choose("");
            else if (!command && !event.altKey && LETTERS.has(key))
                choose(/** @type {string} */ (LETTERS.get(key)), true);
            else return;
            event.preventDefault();
            event.stopPropagation();
        },
        true,
    );
}
