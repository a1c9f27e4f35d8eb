// Mouse, touch and keyboard on the scene.

/** @typedef {import('./camera.js').Camera} Camera */
/**
 * @typedef {object} Actions
 * @property {() => Camera | undefined} camera
 * @property {() => void} moved the camera has moved
 * @property {(x: number, y: number) => void} clicked
 * @property {(x: number, y: number) => void} hovered
 * @property {Record<string, () => void>} keys what to do for a key, by `KeyboardEvent.key`
 */

const CLICK = 4; // pixels that a pointer may move in a click
const ZOOM = 1.0015; // for each pixel that a wheel turns
const LINE = 30; // pixels of a line, in which some browsers measure the wheel
const SPEED = 0.7; // of the keys, distances to the target per second
const TURN = 1.2; // of the arrow keys, radians per second

/** The direction of a key: right, down, ahead; and of the arrows: to turn across and down. */
const MOVES = /** @type {Record<string, [number, number, number]>} */ ({
    KeyA: [-1, 0, 0],
    KeyD: [1, 0, 0],
    KeyE: [0, -1, 0],
    KeyQ: [0, 1, 0],
    KeyW: [0, 0, 1],
    KeyS: [0, 0, -1],
});
const TURNS = /** @type {Record<string, [number, number]>} */ ({
    ArrowLeft: [1, 0],
    ArrowRight: [-1, 0],
    ArrowUp: [0, 1],
    ArrowDown: [0, -1],
});

/** Whether a key belongs to the control that has the keyboard. @param {KeyboardEvent} event */
const isForControl = ({ target, key }) => {
    if (!(target instanceof HTMLElement)) return false;
    if (target instanceof HTMLSelectElement) return true;
    if (key.startsWith("Arrow") && target.closest("aside")) return true; // moves a slider, or scrolls
    return target.matches("button, summary, input") && [" ", "Enter"].includes(key);
};

/** @param {HTMLElement} stage @param {Actions} actions */
export const listen = (stage, { camera, moved, clicked, hovered, keys }) => {
    /** @type {Map<number, {x: number, y: number}>} */
    const pointers = new Map();
    let travelled = 0;
    const height = () => stage.clientHeight;

    /** Middle of the pointers, and their distance from it. */
    const spread = () => {
        const all = [...pointers.values()];
        const x = all.reduce((sum, each) => sum + each.x, 0) / all.length;
        const y = all.reduce((sum, each) => sum + each.y, 0) / all.length;
        return { x, y, size: Math.hypot(all[0].x - x, all[0].y - y) };
    };

    /** @param {number} dx @param {number} dy pixels */
    const pan = (dx, dy) => {
        const now = camera();
        if (!now) return;
        const shown = now.shown({ width: stage.clientWidth, height: height() });
        const unit = (2 * shown[1] * now.distance) / height();
        now.move([-dx * unit, -dy * unit, 0]);
    };

    stage.addEventListener("pointerdown", event => {
        if (event.target instanceof HTMLButtonElement) return;
        stage.setPointerCapture(event.pointerId);
        pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
        if (pointers.size === 1) travelled = 0;
    });
    stage.addEventListener("pointermove", event => {
        const last = pointers.get(event.pointerId);
        const now = camera();
        if (!last || !now) {
            if (!pointers.size) hovered(event.offsetX, event.offsetY);
            return;
        }
        const before = spread();
        const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
        pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
        travelled += Math.hypot(dx, dy);
        if (travelled < CLICK) return;
        if (pointers.size > 1) {
            const after = spread();
            if (before.size > 0 && after.size > 0) now.zoom(before.size / after.size);
            pan(after.x - before.x, after.y - before.y);
        } else if (event.buttons & 6 || event.shiftKey) {
            pan(dx, dy);
        } else {
            const turn = Math.PI / Math.max(height(), 300);
            now.orbit(dx * turn, dy * turn);
        }
        moved();
    });
    stage.addEventListener("pointerup", event => {
        const isClick = pointers.size === 1 && travelled < CLICK && event.button === 0;
        pointers.delete(event.pointerId);
        if (isClick) clicked(event.offsetX, event.offsetY);
    });
    stage.addEventListener("pointercancel", event => pointers.delete(event.pointerId));
    stage.addEventListener("contextmenu", event => event.preventDefault());
    stage.addEventListener(
        "wheel",
        event => {
            event.preventDefault();
            const pixels = event.deltaY * (event.deltaMode ? LINE : 1);
            camera()?.zoom(ZOOM ** Math.max(-400, Math.min(400, pixels)));
            moved();
        },
        { passive: false },
    );

    /** @type {Set<string>} */
    const held = new Set();
    let last = 0;
    /** @param {number} now milliseconds */
    const fly = now => {
        const [seconds, moving] = [Math.min((now - last) / 1000, 0.1), camera()];
        last = now;
        if (!held.size || !moving) return;
        const far = SPEED * seconds * Math.max(moving.distance, 0.1 * moving.extent);
        for (const code of held) {
            if (code in MOVES) moving.move(/** @type {any} */ (MOVES[code].map(each => far * each)));
            else moving.orbit(TURN * seconds * TURNS[code][0], TURN * seconds * TURNS[code][1]);
        }
        moved();
        requestAnimationFrame(fly);
    };
    addEventListener("keydown", event => {
        if (event.ctrlKey || event.metaKey || event.altKey || isForControl(event)) return;
        if (event.code in MOVES || event.code in TURNS) {
            event.preventDefault();
            if (!held.size) {
                last = performance.now();
                requestAnimationFrame(fly);
            }
            held.add(event.code);
        } else if (event.key.toLowerCase() in keys && !event.repeat) {
            event.preventDefault();
            keys[event.key.toLowerCase()]();
        }
    });
    addEventListener("keyup", event => held.delete(event.code));
    addEventListener("blur", () => held.clear());
};
