// Tools for editing in the page of a finished scene; see tools.js. "Save" sends what was changed to
// the studio.

import { addBox } from "./box.js";
import { DELETED, Edits, SELECTED } from "./edits.js";
import { ask, make, Refused } from "./page.js";
import { painter } from "./painting.js";
import { project, times, within } from "./selection.js";
import { say } from "./text.js";
import { about, inverse, levelling, product, turned, UNTURNED } from "./turning.js";

const BRUSH = 24; // its radius at first, in CSS pixels
const AXES = ["x", "y", "z"];
const FINE = 15; // degrees to both sides of a slider
const MOST_NOTES = 25; // the limit of the viewer

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
export function addEditor({ viewer, scene, camera, canvas, hiding, panel, presentView }, picker, centers, version, isEdited, isWhole) {
    const { app, annotations } = viewer;
    const entity = app.root.findByName("gsplat");
    const markers = app.root.findByName("annotations"); // of the viewer; null if there are none
    const views = annotations.map((/** @type {any} */ { camera: { initial } }) => [...initial.position, ...initial.target, initial.fov, scene.aspect]);
    const noted = annotations.map((/** @type {any} */ { title, text }, /** @type {number} */ i) => ({ title, text, view: views[i] }));
    const edits = new Edits(centers.length / 3, noted);
    let tool = "";
    let mode = "replace";
    /** @type {number[][]} */
    let measured = []; // at most two points
    /** @type {number[][]} */
    let floor = []; // at most two points
    /** @type {number[][]} */
    let stroke = []; // points of the window, CSS pixels
    let saving = false;

    // The scene turns about its middle, as the sliders of the page measure from there. Points that are
    // kept are those of the world before the scene is turned.
    const middle = scene.subject.slice(0, 3);
    const placed = (/** @type {number[]} */ point) => turned(edits.present.turn, point, middle);
    const unplaced = (/** @type {number[]} */ point) => turned(inverse(edits.present.turn), point, middle);
    const isTurned = () => Math.abs(edits.present.turn[0]) < 1 - 1e-12;
    /** Shows the scene, and the annotations of the viewer, as they are turned, and further. */
    function place(/** @type {number[]} */ further) {
        const turn = product(further, edits.present.turn);
        const [w, x, y, z] = product(turn, [0, 0, 0, 1]); // the viewer has turned it by 180°
        const origin = turned(turn, [0, 0, 0], middle);
        entity.setLocalRotation(x, y, z, w);
        entity.setLocalPosition(...origin);
        markers?.setLocalRotation(turn[1], turn[2], turn[3], turn[0]);
        markers?.setLocalPosition(...origin);
        views.forEach((/** @type {number[]} */ view, /** @type {number} */ i) => {
            const [position, target] = [view.slice(0, 3), view.slice(3, 6)].map(point => turned(turn, point, middle));
            Object.assign(annotations[i], { position: target });
            Object.assign(annotations[i].camera.initial, { position, target });
        });
        app.renderNextFrame = true;
    }

    // The picture

    const paint = painter(app, hiding);
    let { state: painted, notes: listed } = edits.present;
    let marked = [centers.length / 3, 0, 0];
    function show() {
        const { state, scale, notes } = edits.present;
        place(UNTURNED);
        if (painted !== state) {
            paint((painted = state));
            marked = edits.counts();
        }
        if (listed !== notes) listNotes();
        counts.textContent = !marked[SELECTED] && !marked[DELETED] ? say("edit_first") : say("edit_counts", marked[SELECTED].toLocaleString(), marked[DELETED].toLocaleString());
        remove.disabled = !marked[SELECTED];
        undo.disabled = !edits.past.length;
        redo.disabled = !edits.future.length;
        size.textContent = scale === 1 ? "" : say("edit_size", scale.toPrecision(4));
        save.disabled = saving || !isChanged();
        tellDistance();
        app.renderNextFrame = true;
    }
    const hidden = () => (hides.checked ? hiding.limits() : null);
    const haveNotesChanged = () => JSON.stringify(edits.present.notes) !== JSON.stringify(noted);
    const isChanged = () => {
        const { start, scale } = edits.present;
        return Boolean(start || scale !== 1 || isTurned() || title.value.trim() !== scene.title || marked[DELETED] || hidden() || haveNotesChanged());
    };
    const change = (/** @type {(event?: any) => void} */ run) => (/** @type {any} */ event = undefined) => {
        run(event);
        show();
    };

    // Tools in the window

    const overlay = /** @type {HTMLCanvasElement} */ (make("canvas.snow-overlay", { hidden: true }));
    const drawing = /** @type {CanvasRenderingContext2D} */ (overlay.getContext("2d"));
    const world = () => times(camera.projectionMatrix.data, camera.viewMatrix.data);
    const model = () => times(world(), entity.getWorldTransform().data);
    const box = addBox(centers, canvas, model);
    canvas.after(overlay, box.handles);

    /** Draws the stroke as a rectangle, an area or a line. */
    function trace(/** @type {CanvasRenderingContext2D} */ context) {
        const [first, last] = [stroke[0], stroke[stroke.length - 1]];
        context.beginPath();
        if (tool === "rectangle") context.rect(first[0], first[1], last[0] - first[0], last[1] - first[1]);
        else stroke.forEach(([x, y]) => context.lineTo(x, y));
        if (tool !== "brush") return context.fill();
        context.lineTo(last[0] + 0.01, last[1]); // a point has a round end, too
        context.lineWidth = 2 * Number(radius.value);
        context.lineCap = context.lineJoin = "round";
        context.stroke();
    }

    function draw() {
        const { clientWidth: width, clientHeight: height } = canvas;
        const ratio = devicePixelRatio;
        if (overlay.width !== Math.round(width * ratio) || overlay.height !== Math.round(height * ratio)) {
            overlay.width = Math.round(width * ratio);
            overlay.height = Math.round(height * ratio);
        }
        drawing.setTransform(ratio, 0, 0, ratio, 0, 0);
        drawing.clearRect(0, 0, width, height);
        if (stroke.length) {
            drawing.fillStyle = drawing.strokeStyle = "#ffb45466";
            trace(drawing);
        }
        if (tool === "note") listed.forEach(({ view }, i) => mark(placed(view.slice(3, 6)), String(i + 1)));
        if (tool === "level") floor.forEach((point, i) => mark(placed(point), String(i + 1)));
        if (tool === "box") lines(model(), box.edges(), width, height), box.place();
        if (tool === "measure") {
            const points = measured.map(placed);
            lines(world(), points.length === 2 ? [points] : [], width, height);
            for (const point of points) mark(point, "");
        }
    }

    /** A dot at a point of the world, or a number in it. */
    function mark(/** @type {number[]} */ point, /** @type {string} */ number) {
        const [x, y, depth] = project(world(), point, canvas.clientWidth, canvas.clientHeight);
        if (depth <= 0) return;
        drawing.beginPath();
        drawing.arc(x, y, number ? 11 : 5, 0, 7);
        drawing.fillStyle = "#ffb454";
        drawing.fill();
        drawing.fillStyle = "#14171b";
        drawing.textAlign = "center";
        drawing.fillText(number, x, y + 4);
    }

    function lines(/** @type {Float64Array} */ m, /** @type {number[][][]} */ pairs, /** @type {number} */ width, /** @type {number} */ height) {
        drawing.lineWidth = 2;
        drawing.strokeStyle = "#ffb454";
        drawing.beginPath();
        for (const pair of pairs) {
            const [from, to] = pair.map(point => project(m, point, width, height));
            if (from[2] <= 0 || to[2] <= 0) continue;
            drawing.moveTo(from[0], from[1]);
            drawing.lineTo(to[0], to[1]);
        }
        drawing.stroke();
    }

    function selectStroke(/** @type {PointerEvent} */ event) {
        const { clientWidth: width, clientHeight: height } = canvas;
        const context = /** @type {CanvasRenderingContext2D} */ (Object.assign(document.createElement("canvas"), { width, height }).getContext("2d"));
        trace(context);
        const pixels = context.getImageData(0, 0, width, height).data;
        const shape = new Uint8Array(width * height);
        for (let i = 0; i < shape.length; i++) shape[i] = pixels[4 * i + 3];
        edits.select(within(centers, model(), shape, width, height), event.shiftKey ? "add" : event.altKey ? "remove" : mode);
        stroke = [];
        show();
    }

    /** The point of the surface at a place of the window; null, and a text, if there is none. */
    async function surface(/** @type {number} */ x, /** @type {number} */ y) {
        const found = await picker?.pickSurface(x / canvas.clientWidth, y / canvas.clientHeight);
        tell(found ? "" : say("edit_no_surface"));
        return found ? unplaced([found.position.x, found.position.y, found.position.z]) : null;
    }

    async function measure(/** @type {number} */ x, /** @type {number} */ y) {
        const point = await surface(x, y);
        if (!point) return;
        measured = [...(measured.length === 2 ? [] : measured), point];
        tellDistance();
    }

    async function annotate(/** @type {number} */ x, /** @type {number} */ y) {
        const point = await surface(x, y);
        const { notes } = edits.present;
        if (!point || notes.length >= MOST_NOTES) return;
        const view = presentView();
        const note = { title: say("edit_note_new", notes.length + 1), text: "", view: [...unplaced(view.slice(0, 3)), ...point, view[6], scene.aspect] };
        edits.change({ notes: [...notes, note] });
        show();
    }

    /** The third point of a floor makes it level. */
    async function level(/** @type {number} */ x, /** @type {number} */ y) {
        const point = await surface(x, y);
        if (!point) return;
        setFloor([...floor, point]);
        if (floor.length < 3) return draw();
        const turn = levelling(floor.map(placed), presentView().slice(0, 3));
        setFloor([]);
        if (turn) edits.turnBy(turn);
        else tell(say("edit_on_a_line"));
        show();
        draw();
    }

    function setFloor(/** @type {number[][]} */ points) {
        floor = points;
        floorPoints.textContent = points.length ? say("edit_level_points", points.length) : "";
    }

    function listNotes() {
        listed = edits.present.notes;
        const replaced = (/** @type {number} */ i, /** @type {any} */ changes) => edits.present.notes.map((note, k) => (k === i ? { ...note, ...changes } : note));
        const field = (/** @type {number} */ i, /** @type {"title" | "text"} */ key, /** @type {number} */ most) =>
            make("input", { type: "text", maxlength: most, value: listed[i][key], "aria-label": say(`edit_note_${key}`), placeholder: say(`edit_note_${key}`),
                input: change((/** @type {any} */ event) => {
                    edits.change({ notes: replaced(i, { [key]: event.target.value }) }, `${key} ${i}`);
                    listed = edits.present.notes; // the field has the text already
                }) });
        const drop = (/** @type {number} */ i) => change(() => edits.change({ notes: edits.present.notes.filter((_, k) => k !== i) }));
        noteList.replaceChildren(
            ...listed.map((_, i) => make("div.snow-buttons", {}, make("b", {}, String(i + 1)), field(i, "title", 60), field(i, "text", 280), button("film_remove", drop(i)))),
        );
        draw();
    }

    /** The measured distance in units of the scene that is saved; 0 if there is none. */
    function distance() {
        if (measured.length < 2) return 0;
        const [a, b] = measured;
        return (edits.present.scale * Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2])) / scene.scale;
    }

    function tellDistance() {
        const found = distance();
        // Set scale makes a unit of the scene that is saved a metre.
        const metres = edits.present.scale === 1 ? scene.metres : 1;
        const length = metres ? `${(metres * found).toPrecision(4)} m` : found.toPrecision(4);
        measure_.textContent = found ? say("edit_distance", length) : say("edit_two_points");
        rescale.disabled = !found;
        draw();
    }

    overlay.addEventListener("pointerdown", event => {
        if (!event.isPrimary || event.button) return;
        event.preventDefault();
        if (tool === "measure") measure(event.offsetX, event.offsetY);
        else if (tool === "note") annotate(event.offsetX, event.offsetY);
        else if (tool === "level") level(event.offsetX, event.offsetY);
        else {
            overlay.setPointerCapture(event.pointerId);
            stroke = [[event.offsetX, event.offsetY]];
        }
    });
    overlay.addEventListener("pointermove", event => {
        if (stroke.length && event.isPrimary) stroke.push([event.offsetX, event.offsetY]);
    });
    overlay.addEventListener("pointerup", event => {
        if (stroke.length && event.isPrimary) selectStroke(event);
    });
    overlay.addEventListener("pointercancel", () => (stroke = []));
    // Zoom works with every tool.
    overlay.addEventListener("wheel", event => {
        event.preventDefault();
        canvas.dispatchEvent(new WheelEvent("wheel", event));
    });
    app.on("update", () => {
        if (!overlay.hidden) draw();
    });

    // The panel

    const button = (/** @type {string} */ key, /** @type {() => void} */ click) =>
        /** @type {HTMLButtonElement} */ (make("button", { type: "button", click }, say(key)));
    const choices = (/** @type {string[]} */ names, /** @type {(name: string) => void} */ choose) => {
        const buttons = names.map(name => button(`edit_${name}`, () => choose(name)));
        const mark = (/** @type {string} */ chosen) => buttons.forEach((each, i) => (each.ariaPressed = String(names[i] === chosen)));
        return { buttons, mark };
    };
    const tools = choices(["rectangle", "lasso", "brush", "box", "measure", "note", "level"], name => choose(tool === name ? "" : name));
    const modes = choices(["replace", "add", "remove"], name => modes.mark((mode = name)));
    function choose(/** @type {string} */ name) {
        tool = name;
        tools.mark(name);
        overlay.hidden = !name;
        // The box is moved by its handles, and the camera by the window.
        overlay.style.pointerEvents = name === "box" ? "none" : "auto";
        forSelection.hidden = ["measure", "note", "level"].includes(name);
        forBrush.hidden = name !== "brush";
        forBox.hidden = box.handles.hidden = name !== "box";
        forMeasure.hidden = name !== "measure";
        forNotes.hidden = name !== "note";
        forLevel.hidden = name !== "level";
        setFloor([]);
    }

    const forSelection = make("div.snow-buttons", { role: "group", "aria-label": say("edit_mode") }, ...modes.buttons, button("edit_invert", change(() => edits.invert())));
    const radius = /** @type {HTMLInputElement} */ (make("input", { type: "range", min: 4, max: 120, value: BRUSH }));
    const forBrush = make("label", {}, say("edit_radius"), radius);
    const forBox = make("div", {}, make("p", {}, say("edit_box_how")), ...box.sliders, button("edit_outside", change(() => edits.select(box.outside(), mode))));
    const measure_ = make("span", { role: "status" }, say("edit_two_points"));
    const truth = /** @type {HTMLInputElement} */ (make("input", { type: "number", min: 0, step: "any", "aria-label": say("edit_truth"), placeholder: say("edit_truth") }));
    const rescale = button("edit_rescale", () => {
        const wanted = Number(truth.value);
        if (!(wanted > 0)) return truth.focus();
        edits.change({ scale: (edits.present.scale * wanted) / distance() });
        show();
    });
    rescale.disabled = true;
    const size = make("span");
    const forMeasure = make("div.snow-buttons", {}, measure_, truth, rescale, size);
    const noteList = make("div");
    const forNotes = make("div", {}, make("p", {}, say("edit_note_how")), noteList);
    const turns = AXES.map((axis, k) => {
        const by = (/** @type {number} */ degrees) =>
            make("button", { type: "button", "aria-label": say("edit_turn", axis, degrees), click: change(() => edits.turnBy(about(k, degrees))) }, `${degrees > 0 ? "+" : "−"}90°`);
        const fine = /** @type {HTMLInputElement} */ (
            make("input", {
                type: "range", min: -FINE, max: FINE, step: "any", value: 0, "aria-label": say("edit_turn_fine", axis),
                input: () => place(about(k, Number(fine.value))),
                change: change(() => {
                    if (Number(fine.value)) edits.turnBy(about(k, Number(fine.value)));
                    fine.value = "0";
                }),
            })
        );
        return make("div.snow-turn", {}, make("b", {}, axis), by(-90), fine, by(90));
    });
    const floorPoints = make("p", { role: "status" });
    const forLevel = make("div.snow-level", {}, make("p", {}, say("edit_level_how")), floorPoints, ...turns);
    const hides = /** @type {HTMLInputElement} */ (make("input", { type: "checkbox", change: change(() => {}) }));
    const remove = button("edit_delete", change(() => edits.delete()));
    const undo = button("edit_undo", change(() => go("undo")));
    const redo = button("edit_redo", change(() => go("redo")));
    function go(/** @type {"undo" | "redo"} */ way) {
        edits[way]();
        tell("");
    }
    const counts = make("p", { role: "status" });
    const title = /** @type {HTMLInputElement} */ (make("input", { type: "text", maxlength: 80, value: scene.title, "aria-label": say("title_label"), input: change(() => {}) }));
    const view = button("edit_start", change(() => {
        const seen = presentView();
        edits.change({ start: [...unplaced(seen.slice(0, 3)), ...unplaced(seen.slice(3, 6)), seen[6], scene.aspect] });
        tell(say("edit_start_set"));
    }));
    const told = make("p", { role: "status" });
    const tell = (/** @type {string} */ text) => (told.textContent = text);

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
            tell(error instanceof Refused ? error.message : say("offline"));
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
            turn: isTurned() ? turn : null,
        });
    });
    const back = button("edit_back", () => {
        if (confirm(say("edit_back_sure"))) send("DELETE", undefined);
    });
    const keep = (/** @type {Event} */ event) => {
        if (isChanged()) event.preventDefault();
    };
    addEventListener("beforeunload", keep);

    const row = (/** @type {(Node | false)[]} */ ...parts) => make("div.snow-buttons", {}, ...parts);
    const content = make(
        "div.snow-edit.snow-tools.snow-card",
        { hidden: true },
        row(...tools.buttons),
        forSelection,
        forBrush,
        forBox,
        forMeasure,
        forNotes,
        forLevel,
        make("label.snow-check", {}, hides, say("edit_hides")),
        row(remove, undo, redo),
        counts,
        row(title, view),
        row(save, isEdited && back),
        told,
    );
    const open = button("edit", () => {
        content.hidden = !content.hidden;
        open.ariaExpanded = String(!content.hidden);
        if (content.hidden) choose("");
    });
    open.ariaExpanded = "false";
    panel.querySelector(".snow-copied").before(open);
    panel.querySelector(".snow-card").after(content);
    // The page fades its panel when its controls hide.
    viewer.events.on("controlsHidden:changed", () => {
        if (!content.hidden) panel.classList.remove("snow-faded");
    });
    // The sliders change what is saved.
    hiding.element.addEventListener("input", () => show());
    choose("");
    listNotes();
    modes.mark(mode);
    show();
    if (isWhole) open.click();

    const isField = (/** @type {Event} */ event) => event.target instanceof HTMLInputElement && ["text", "number"].includes(event.target.type);
    // Keys in fields are not for the camera.
    for (const kind of ["keydown", "keyup"])
        content.addEventListener(kind, event => {
            if (isField(event)) event.stopPropagation();
        });
    addEventListener(
        "keydown",
        event => {
            if (content.hidden || saving || isField(event)) return;
            const command = event.ctrlKey || event.metaKey;
            const key = event.key.toLowerCase();
            if (command && key === "z") change(() => go(event.shiftKey ? "redo" : "undo"))();
            else if (command && key === "y") change(() => go("redo"))();
            else if (key === "delete" || key === "backspace") change(() => edits.delete())();
            else if (key === "escape" && tool) choose("");
            else return;
            event.preventDefault();
            event.stopPropagation();
        },
        true,
    );
}
