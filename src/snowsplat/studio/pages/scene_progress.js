// A job: its progress, and why it has stopped.

import { action, ask, command, duration, make } from "./page.js";
import { againPart, start } from "./scene_start.js";
import { dressed, say, told } from "./text.js";

const STAGES = ["demo", "photos", "poses", "images", "report", "scene", "pictures", "all", "page"];

/** The stages, the photos, the map and the figures of the training. */
export function progressPart(/** @type {import("./scene.js").ScenePage} */ page) {
    const stages = make("ol.stages");
    const present = make("div.present");
    const figures = make("dl.figures");
    const curve = make("div.curve");
    const strip = make("div.strip", {
        role: "group",
        "aria-label": say("placed"),
        tabindex: 0,
    });
    const map = make("img.map", { alt: say("map") });
    const mapBox = make("figure", { hidden: true }, map, make("figcaption", {}, say("map")));
    const notes = make("ul.notes");
    const notesPart = make("section", { hidden: true }, make("h2", {}, say("log")), notes);
    const stop = make(
        "button.plain",
        { type: "button", click: action(() => ask(`${page.address}/stop`, "POST", {})) },
        say("stop"),
    );
    const live = /** @type {HTMLIFrameElement} */ (
        make("iframe.viewer", { title: say("live"), allow: "fullscreen", hidden: true })
    );
    let listed = "";
    let drawn = 0; // the map that is shown
    page.update = now => {
        const state = now.state;
        showStages(stages, now);
        showNow(present, now);
        showFigures(figures, curve, state);
        notesPart.hidden = !state.notes?.length;
        notes.replaceChildren(...(state.notes ?? []).map(line => make("li", {}, told(line))));
        if (live.hidden === now.has_page) {
            live.hidden = !now.has_page;
            live.src = now.has_page ? dressed(`${page.address}/live/`) : "about:blank";
        }
        mapBox.hidden = !now.map;
        if (now.map && now.map !== drawn) map.setAttribute("src", `${page.address}/map?${(drawn = now.map)}`);
        // The map is drawn anew when photos have been placed.
        const key = [now.map, ...(state.stages ?? []).map(each => each.stage)].join();
        if (key !== listed) {
            listed = key;
            ask(`${page.address}/photos`).then(
                photos => showPhotos(strip, page.address, photos),
                () => (listed = ""),
            );
        }
    };
    return [
        make("section.card.row", {}, present, make("div.stop", {}, stop, make("span.soft", {}, say("stop_help")))),
        live,
        // The map is beside the stages, so that it is seen while it grows.
        make("div.row.wide", {}, make("section.card", {}, stages), mapBox),
        strip,
        make("details.card", {}, make("summary", {}, say("more")), figures, curve, notesPart),
    ];
}

export function stoppedPart(
    /** @type {import("./scene.js").ScenePage} */ page,
    /** @type {import("./types.js").Scene} */ scene,
) {
    const state = scene.state;
    const why = {
        failed: state.error,
        stopped: say("was_stopped"),
        interrupted: say("was_killed"),
    }[/** @type {string} */ (scene.status)];
    const wanted = () => (scene.minutes ? { minutes: scene.minutes } : { quality: scene.quality });
    const stages = make("ol.stages");
    showStages(stages, scene);
    return [
        make(
            "section.card",
            {},
            make(scene.status === "failed" ? "p.bad" : "p", { role: "alert" }, told(why ?? "")),
            make("button.main", { type: "button", click: action(start(page, wanted)) }, say("resume")),
            stages,
            make("details", {}, make("summary", {}, say("command")), command(scene.command)),
        ),
        ...againPart(page, scene),
    ];
}

function showStages(/** @type {HTMLElement} */ list, /** @type {import("./types.js").Scene} */ scene) {
    const { stages = [], now } = scene.state;
    const done = new Map(stages.map(each => [each.stage, each]));
    const current = now?.stage ?? "";
    const names = STAGES.filter(
        name =>
            done.has(name) ||
            name === current ||
            // Only the example has the first stage.
            (scene.status === "running" && STAGES.indexOf(name) > Math.max(0, STAGES.indexOf(current))),
    );
    list.replaceChildren(
        ...names.map(name => {
            const past = done.get(name);
            const item = make(
                "li",
                { "data-state": past ? "done" : name === current ? "now" : "later" },
                make("b", {}, say(`stage_${name}`)),
            );
            if (past) {
                const result = name === "report" ? "" : `${told(past.lines[0])} `;
                item.append(
                    make("span.soft", {}, ` ${result}(${past.again ? say("before") : duration(past.seconds)})`),
                );
            }
            return item;
        }),
    );
}

/** The stage that runs, how far it is, and the time that is left. */
function showNow(/** @type {HTMLElement} */ element, /** @type {import("./types.js").Scene} */ { title, state }) {
    const { now, steps } = state;
    if (!now) return element.replaceChildren(make("p", {}, "…"));
    const training = now.stage === "scene" && steps;
    const [count, total, left] = training
        ? [steps.step, steps.iterations, steps.left]
        : [now.done ?? 0, now.total, now.left];
    const name = say(`stage_${now.stage}`);
    const what = training ? say("step").toLowerCase() : told(now.what ?? "");
    const number = total ? say("of", count.toLocaleString(), total.toLocaleString()) : count || "";
    element.replaceChildren(
        make("p", {}, make("b", {}, name), make("span.soft", {}, ` ${what} ${number}`)),
        make("progress", { ...(total ? { max: total, value: count } : {}), "aria-label": name }),
        make("p.soft", {}, left ? say("left", duration(left)) : ""),
    );
    // Another tab of the browser shows it, too.
    if (left) document.title = `${say("left", duration(left))} – ${title}`;
}

function showFigures(
    /** @type {HTMLElement} */ figures,
    /** @type {HTMLElement} */ curve,
    /** @type {import("./types.js").State} */ { steps, curve: points = [] },
) {
    if (!steps) return;
    const fact = (/** @type {string} */ key, /** @type {string} */ value) => [
        make("dt", {}, say(key)),
        make("dd", {}, value),
    ];
    figures.replaceChildren(
        ...fact("step", say("of", steps.step.toLocaleString(), steps.iterations.toLocaleString())),
        ...fact("gaussians", steps.gaussians.toLocaleString()),
        ...(steps.psnr ? fact("psnr", `${steps.psnr.toFixed(2)} dB`) : []),
    );
    if (points.length < 2) return;
    const values = points.map(point => Math.log(Math.max(point[1], 1e-9)));
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const last = points[points.length - 1][0];
    const way = values.map(
        (value, i) =>
            `${((300 * points[i][0]) / last).toFixed(1)},${(78 - (76 * (value - low)) / (high - low || 1)).toFixed(1)}`,
    );
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("viewBox", "0 0 300 80");
    svg.setAttribute("preserveAspectRatio", "none");
    svg.setAttribute("role", "img");
    svg.setAttribute("aria-label", say("loss"));
    const line = document.createElementNS(svg.namespaceURI, "polyline");
    line.setAttribute("points", way.join(" "));
    svg.append(line);
    curve.replaceChildren(svg, make("figcaption", {}, say("loss")));
}

/** Pictures that are there already remain; those of photos without a pose are dim. */
function showPhotos(
    /** @type {HTMLElement} */ strip,
    /** @type {string} */ address,
    /** @type {import("./types.js").Photo[]} */ photos,
) {
    const there = /** @type {HTMLImageElement[]} */ ([...strip.children]);
    const same = there.length === photos.length && photos.every(({ name }, i) => there[i].alt === name);
    if (!same)
        strip.replaceChildren(
            ...photos.map(({ name }, i) =>
                make("img", {
                    src: `${address}/photos/${i}?${encodeURIComponent(name)}`,
                    alt: name,
                    title: name,
                    loading: "lazy",
                }),
            ),
        );
    photos.forEach(({ placed }, i) => strip.children[i].classList.toggle("waits", !placed));
}
