// A film of a finished scene: key views on a time line, a preview, and the video that the studio
// renders. The path through the keys is that of the studio, so the preview is what is rendered.

import { action, ask, button, bytes, command, make, reasonOf } from "./page.js";
import { say, told } from "./text.js";

const SIZES = ["1920x1080", "1080x1920", "1080x1080"];
const TURN = 8; // keys of a turn around the target
const GAP = (110 * Math.PI) / 180; // a wider one between photos has nothing to show, as for `render --path`
const FASTEST = 3; // the speeds at a key are from 1/8 to 8, in steps of the square root of 2
const ADDRESS = "../film"; // relative to the page

/**
 * Views around the target of a view, turned by angles about the vertical.
 * @param {number[]} view position, target, field of view, aspect
 * @param {number[]} angles radians
 */
export function around([x, y, z, u, v, w, ...lens], angles) {
    return angles.map(angle => {
        const [sine, cosine] = [Math.sin(angle), Math.cos(angle)];
        return [u + cosine * (x - u) + sine * (z - w), y, w + cosine * (z - w) - sine * (x - u), u, v, w, ...lens];
    });
}

/**
 * The angles of a turn: all round, beginning with the view; or, if photos show one side only, there and
 * back over that side.
 * @param {number[]} view position, target, field of view, aspect
 * @param {number[][]} photos views of photos
 * @param {number} count
 */
export function turnOver([x, , z, u, , w], photos, count) {
    const whole = Array.from({ length: count }, (_, i) => (2 * Math.PI * i) / count);
    const own = Math.atan2(z - w, x - u);
    // As angles of a turn from the view, in increasing order.
    const seen = photos
        .map(photo => (own - Math.atan2(photo[2] - w, photo[0] - u) + 4 * Math.PI) % (2 * Math.PI))
        .sort((a, b) => a - b);
    if (!seen.length) return whole;
    const gaps = seen.map((angle, i) => (seen[i + 1] ?? seen[0] + 2 * Math.PI) - angle);
    const widest = gaps.indexOf(Math.max(...gaps));
    if (gaps[widest] < GAP) return whole;
    const from = seen[(widest + 1) % seen.length];
    const arc = 2 * Math.PI - gaps[widest];
    // A swing: as a pendulum, its keys are closer to each other at its ends.
    return whole.map(angle => from + (arc * (1 - Math.cos(angle))) / 2);
}

/**
 * The camera at a share of the time of a path, between two of its cameras.
 * @param {number[][]} path position, point ahead, up, field of view
 * @param {number} share 0..1
 */
export function cameraAt(path, share) {
    const at = share * (path.length - 1);
    const before = Math.min(Math.floor(at), path.length - 2);
    return path[before].map((value, i) => value + (at - before) * (path[before + 1][i] - value));
}

/** A speed, for people. */
const times = (/** @type {number} */ speed) => `×${Number(speed.toPrecision(2))}`;

/**
 * @param {any} page see panel.js
 * @param {string} version of the scene that the page shows: keys are in its frame
 */
export function addFilm({ viewer, scene, camera, canvas, panel, presentView, flyTo }, version) {
    /** @type {{view: number[], speed: number}[]} */
    let keys = [];
    let chosen = -1; // the key that was added or shown last
    /** @type {number[][] | null} */
    let path = null; // of the present plan, when the studio has computed it
    let share = 0; // of the time of the film
    let playing = false;
    let previewing = false;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    let timer;

    const status = make("p", { role: "status" });
    const tell = (/** @type {string} */ text) => (status.textContent = text);

    // The plan

    const seconds = /** @type {HTMLInputElement} */ (
        make("input", { type: "number", min: 1, max: 600, step: "any", value: 10, change: changed })
    );
    const size = /** @type {HTMLSelectElement} */ (
        make("select", { change: changed }, ...SIZES.map(value => make("option", { value }, say(`film_${value}`))))
    );
    const ease = /** @type {HTMLInputElement} */ (make("input", { type: "checkbox", checked: true, change: changed }));
    const loop = /** @type {HTMLInputElement} */ (make("input", { type: "checkbox", change: changed }));
    // Its speeds are relative to each other, as the seconds are the length of the film.
    const speed = /** @type {HTMLInputElement} */ (
        make("input", {
            type: "range",
            min: -FASTEST,
            max: FASTEST,
            step: 0.5,
            value: 0,
            input: () => setSpeed(),
            change: changed,
        })
    );
    function setSpeed() {
        keys[chosen].speed = 2 ** Number(speed.value);
        draw();
    }
    const speedText = make("span");
    const plan = () => ({
        keys: keys.map(key => key.view),
        speeds: keys.map(key => key.speed),
        seconds: Number(seconds.value),
        size: size.value,
        ease: ease.checked,
        loop: loop.checked,
    });
    const canPlay = () => keys.length >= (loop.checked ? 3 : 2) && Number(seconds.value) > 0;

    function changed() {
        path = null;
        stopPreview();
        draw();
    }

    function draw() {
        line.replaceChildren(
            ...keys.map((key, i) => {
                const show = () => {
                    stopPreview();
                    chosen = i;
                    flyTo(key.view.slice(0, 7));
                    draw();
                };
                const label =
                    say("film_key", i + 1) + (key.speed === 1 ? "" : `, ${say("film_speed")} ${times(key.speed)}`);
                return make(
                    "button",
                    {
                        type: "button",
                        "aria-label": label,
                        "aria-current": i === chosen && "true",
                        click: show,
                    },
                    String(i + 1),
                    key.speed !== 1 && make("small", {}, times(key.speed)),
                );
            }),
        );
        speedOfKey.hidden = chosen < 0;
        if (chosen >= 0) {
            speed.value = String(Math.log2(keys[chosen].speed));
            speedText.textContent = `${say("film_key", chosen + 1)}: ${say("film_speed")} ${times(keys[chosen].speed)}`;
        }
        empty.hidden = canPlay();
        replace.disabled = remove.disabled = chosen < 0;
        play.disabled = render.disabled = position.disabled = !canPlay();
        play.textContent = say(playing ? "film_pause" : "film_preview");
        position.value = String(share);
        viewer.app.renderNextFrame = true;
    }

    const view = () => [...presentView(), scene.aspect];
    const add = button("film_add", () => {
        keys.splice(chosen + 1, 0, { view: view(), speed: 1 });
        chosen += 1;
        changed();
    });
    const replace = button("film_replace", () => {
        keys[chosen].view = view();
        changed();
    });
    const remove = button("film_remove", () => {
        keys.splice(chosen, 1);
        chosen = Math.min(chosen, keys.length - 1);
        changed();
    });
    const turn = button("film_turn", () => {
        keys = around(view(), turnOver(view(), scene.stops, TURN)).map(each => ({ view: each, speed: 1 }));
        chosen = TURN - 1;
        loop.checked = true;
        ease.checked = false;
        changed();
    });
    const line = make("div.snow-keys", { role: "group", "aria-label": say("film_line") });
    const empty = make("p", {}, say("film_empty"));
    const speedOfKey = make("label.snow-speed", {}, speedText, speed);

    // The preview

    const position = /** @type {HTMLInputElement} */ (
        make("input", {
            type: "range",
            min: 0,
            max: 1,
            step: 0.001,
            value: 0,
            "aria-label": say("film_line"),
            input: () => scrub(),
        })
    );
    const frame = make("div.snow-frame", { hidden: true, "aria-hidden": "true" });
    canvas.after(frame);

    async function findPath() {
        if (path) return;
        tell(say("preparing"));
        const asked = JSON.stringify(plan());
        const found = await ask(`${ADDRESS}/path?version=${version}`, "POST", plan());
        tell("");
        if (asked === JSON.stringify(plan())) path = found.path;
    }

    async function begin() {
        await findPath();
        previewing = Boolean(path) && !content.hidden; // the tools may have been closed meanwhile
        frame.hidden = !previewing;
    }

    const fail = (/** @type {any} */ error) => tell(reasonOf(error));
    function scrub() {
        playing = false;
        share = Number(position.value);
        begin().then(draw, fail);
    }

    const play = button(
        "film_preview",
        action(async () => {
            if (playing) {
                playing = false;
            } else {
                await begin().catch(fail);
                playing = previewing;
                if (share >= 1) share = 0;
            }
            // The action enables its button when this has ended.
            setTimeout(draw);
        }),
    );

    /** The camera is that of the visitor again. */
    function stopPreview() {
        playing = previewing = false;
        frame.hidden = true;
    }

    // This follows the handlers of the viewer and of the panel, which set the camera, too.
    viewer.app.on("update", (/** @type {number} */ passed) => {
        if (!previewing || !path) return;
        if (playing) {
            share = Math.min(1, share + passed / Number(seconds.value));
            position.value = String(share);
            if (share >= 1) {
                playing = false;
                draw();
            }
        }
        const [x, y, z, u, v, w, a, b, c, fov] = cameraAt(path, share);
        camera.entity.setPosition(x, y, z);
        camera.entity.lookAt(u, v, w, a, b, c);
        // The window shows the whole picture of the film, in a frame.
        const [wide, high] = size.value.split("x").map(Number);
        const { clientWidth: width, clientHeight: height } = canvas;
        const scale = Math.min(width / wide, height / high);
        const half = (Math.tan((fov * Math.PI) / 360) * height) / (high * scale);
        const longer = camera.horizontalFov ? (half * width) / height : half;
        camera.fov = (Math.atan(longer) * 360) / Math.PI;
        Object.assign(frame.style, { width: `${wide * scale}px`, height: `${high * scale}px` });
        viewer.app.renderNextFrame = true;
    });
    // Whoever moves the camera wants it back.
    const takeBack = () => {
        stopPreview();
        draw();
    };
    canvas.addEventListener("pointerdown", () => {
        if (previewing) takeBack();
    });

    addEventListener("keydown", event => {
        if (event.key === "Escape" && previewing) takeBack();
    });

    // The video

    const progress = make("progress", {
        max: 1,
        value: 0,
        hidden: true,
        "aria-label": say("film_rendering"),
    });
    const result = make("div");
    const render = button(
        "film_render",
        action(async () => {
            stopPreview();
            await ask(`${ADDRESS}?version=${version}`, "POST", plan()).catch(fail);
            await look();
            setTimeout(draw);
        }),
    );
    const stop = button(
        "stop",
        action(() => ask(ADDRESS, "DELETE").then(look, fail)),
    );

    /** What the studio has; while it renders, again and again. */
    async function look() {
        clearTimeout(timer);
        const now = await ask(ADDRESS).catch(() => null);
        if (!now) {
            timer = setTimeout(look, 3000);
            return;
        }
        const wasRunning = !progress.hidden;
        progress.hidden = stop.hidden = !now.running;
        render.hidden = now.running;
        if (now.running) {
            const { done = 0, total = 0, left } = now.now ?? {};
            progress.setAttribute("value", String(total ? done / total : 0));
            tell(total ? `${say("film_rendering")} ${say("of", done, total)}` : say("film_rendering"));
            timer = setTimeout(look, 1000);
            return left;
        }
        if (wasRunning)
            tell(now.outcome === "failed" ? told(now.error) : now.outcome === "done" ? "" : say("film_stopped"));
        result.replaceChildren();
        if (now.bytes && !now.running) {
            const download = make(
                "a",
                { href: `${ADDRESS}/file`, download: true },
                say("film_download", bytes(now.bytes)),
            );
            result.append(make("p", {}, download), command(now.command));
        }
        if (!keys.length && now.plan) {
            keys = now.plan.keys.map((/** @type {number[]} */ each, /** @type {number} */ i) => ({
                view: each,
                speed: now.plan.speeds[i] ?? 1,
            }));
            chosen = keys.length - 1;
            seconds.value = now.plan.seconds;
            size.value = now.plan.size;
            ease.checked = now.plan.ease;
            loop.checked = now.plan.loop;
            draw();
        }
    }

    // The panel

    const row = (/** @type {Node[]} */ ...parts) => make("div.snow-buttons", {}, ...parts);
    const content = make(
        "div.snow-film.snow-tools.snow-card",
        { hidden: true },
        row(add, replace, remove, turn),
        empty,
        line,
        speedOfKey,
        make("label", {}, say("film_seconds"), seconds),
        make("label", {}, say("film_size"), size),
        make("label.snow-check", {}, ease, say("film_ease")),
        make("label.snow-check", {}, loop, say("film_loop")),
        position,
        row(play, render, stop),
        progress,
        status,
        result,
    );
    const open = button("film", () => {
        content.hidden = !content.hidden;
        open.ariaExpanded = String(!content.hidden);
        if (content.hidden) stopPreview();
        else look();
    });
    open.ariaExpanded = "false";
    panel.querySelector(".snow-copied").before(open);
    panel.querySelector(".snow-card").after(content);
    // Keys in fields are not for the camera.
    for (const kind of ["keydown", "keyup"])
        content.addEventListener(kind, event => {
            if (event.target instanceof HTMLInputElement || event.target instanceof HTMLSelectElement)
                event.stopPropagation();
        });
    stop.hidden = true;
    draw();
}
