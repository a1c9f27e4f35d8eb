// The page of one scene: uploads, what the photos are, the progress of the job, and the result.

import { action, ask, bytes, command, duration, make, notice, reasonOf } from "./page.js";
import { dressed, say, told } from "./text.js";
import { chosen, dropped, Upload } from "./upload.js";

const STAGES = ["photos", "poses", "images", "report", "scene", "pictures", "all", "page"];
const FACTS = ["photos", "sizes", "cameras", "with_gps", "videos", "poses", "not_used", "doubtful"];

/** @type {Map<string, Upload>} */
const uploads = new Map();

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

/** Shows a scene in an element, until `closed` is aborted. */
export function showScene(
    /** @type {HTMLElement} */ main,
    /** @type {string} */ name,
    /** @type {AbortSignal} */ closed,
) {
    const address = `scenes/${encodeURIComponent(name)}`;
    const title = make("h1");
    const status = make("p.status", { role: "status" });
    const body = make("div");
    main.replaceChildren(make("p", {}, make("a", { href: "#" }, `← ${say("back")}`)), title, status, body);
    let uploaded = false; // whether its photos are uploaded, not in a folder of the machine
    let away = false; // whether the server did not answer
    let shown = ""; // which parts `body` has
    /** @type {((scene: any) => void) | undefined} */
    let update;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    let timer;

    async function refresh() {
        clearTimeout(timer);
        let wait = 1000;
        try {
            const scene = await ask(address);
            if (closed.aborted) return;
            if (away) notice("");
            away = false;
            show(scene);
            if (scene.status !== "running") wait = 4000;
        } catch (error) {
            if (closed.aborted) return;
            away = true;
            notice(reasonOf(error, "offline"));
            wait = 3000;
        }
        timer = setTimeout(refresh, wait);
    }

    function show(/** @type {any} */ scene) {
        title.textContent = document.title = scene.title;
        const sending = uploads.has(name);
        status.textContent = sending ? "" : say(scene.status);
        status.dataset.status = scene.status;
        uploaded = scene.inputs.length === 0 && !scene.found;
        const parts = sending ? "upload" : scene.status;
        if (parts !== shown) {
            shown = parts;
            update = undefined;
            /** @type {Record<string, (scene: any) => HTMLElement[]>} */
            const builders = {
                upload: sendingPart,
                new: startPart,
                running: progressPart,
                done: resultPart,
                found: openingPart,
                opening: openingPart,
            };
            body.replaceChildren(
                ...(builders[parts] ?? stoppedPart)(scene),
                ...(["upload", "running", "found", "opening"].includes(parts) ? [] : [keptPart(scene)]),
            );
        }
        update?.(scene);
    }

    const start = (/** @type {any} */ wanted) => async () => {
        await ask(`${address}/start`, "POST", wanted());
        await refresh();
    };

    function sendingPart() {
        const bar = make("progress", { max: 1, "aria-label": say("files", "", "") });
        const line = make("p");
        const more = moreFiles();
        update = () => {
            const sending = uploads.get(name);
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

    /** A scene of the command line has no site yet; that of another one is not written. */
    function openingPart(/** @type {any} */ scene) {
        const line = make("p", { role: "status" }, say("opening"));
        const tell = (/** @type {any} */ error) => {
            line.textContent = reasonOf(error);
            body.append(keptPart(scene)); // a scene that cannot be opened can be removed
        };
        ask(`${address}/open`, "POST", {}).then(refresh, tell);
        return [make("section.card", {}, line)];
    }

    /** Its name, its folder, and how to remove it. */
    function keptPart(/** @type {any} */ scene) {
        const name = /** @type {HTMLInputElement} */ (
            make("input", {
                type: "text",
                value: scene.title,
                maxlength: 80,
                "aria-label": say("title_label"),
            })
        );
        const rename = async () => {
            await ask(`${address}/rename`, "POST", { title: name.value });
            shown = "";
            await refresh();
        };
        const remove = async () => {
            if (!confirm(say("remove_sure", scene.title))) return;
            const { photos } = await ask(address, "DELETE");
            location.hash = "";
            // The other page hides notices when it begins.
            setTimeout(() => notice(photos ? say("removed_but", photos) : say("removed")));
        };
        return make(
            "section.card",
            {},
            // The form that starts the job has the name, too.
            scene.status === "done" &&
                make(
                    "form.row",
                    {},
                    name,
                    make("button.plain", { type: "submit", click: action(rename) }, say("rename")),
                ),
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

    /** What the photos are, and a form that starts the job. */
    function startPart(/** @type {any} */ scene) {
        const facts = make("section.card", {}, make("p", {}, say("looking")));
        const form = startForm(scene, say("start"));
        form.hidden = true;
        look();
        return [facts, form];

        async function look() {
            try {
                /** @type {any[]} */
                const files = uploaded ? await ask(`${address}/uploads`) : [];
                const parts = files.filter(file => file.received < file.size).length;
                const found = !uploaded || files.length > parts ? await ask(`${address}/survey`, "POST") : null;
                if (closed.aborted || shown !== "new") return;
                facts.replaceChildren(...(found ? factsOf(found.facts) : [make("p", {}, say("no_files"))]));
                if (parts) facts.append(make("p.bad", { role: "alert" }, say("not_arrived", parts)));
                if (uploaded) facts.append(moreFiles());
                form.hidden = !found;
                for (const [quality, seconds] of Object.entries(found?.seconds ?? {})) {
                    const time = form.querySelector(`[data-quality=${quality}]`);
                    if (time) time.textContent = say("about_time", duration(Number(seconds)));
                }
            } catch (error) {
                facts.replaceChildren(make("p.bad", { role: "alert" }, reasonOf(error)));
                if (uploaded) facts.append(moreFiles());
            }
        }
    }

    /** With more photos, or another quality. */
    function againPart(/** @type {any} */ scene) {
        return [...(uploaded ? [moreFiles()] : []), startForm(scene, say("again"))];
    }

    function moreFiles() {
        const input = make("input", {
            type: "file",
            multiple: true,
            change: (/** @type {any} */ event) => add(chosen(event.target.files)),
        });
        return make("p", {}, make("label.button.plain", {}, say("add_files"), input));
    }

    function add(/** @type {import("./upload.js").Item[]} */ items) {
        if (items.length) upload(name, items);
    }

    function startForm(/** @type {any} */ scene, /** @type {string} */ label) {
        const minutes = /** @type {HTMLInputElement} */ (
            make("input", {
                type: "number",
                min: 0.5,
                max: 10080,
                step: "any",
                value: scene.minutes ?? 10,
                "aria-label": say("minutes_label"),
            })
        );
        const before = scene.minutes ? "within" : (scene.quality ?? "normal");
        const choice = (/** @type {string} */ value, /** @type {Node} */ more) =>
            make(
                "label.choice",
                {},
                make("input", { type: "radio", name: "quality", value, checked: value === before }),
                make("b", {}, say(value)),
                more,
            );
        const title = /** @type {HTMLInputElement} */ (
            make("input", { type: "text", value: scene.title, maxlength: 80 })
        );
        const form = /** @type {HTMLFormElement} */ (
            make(
                "form.card",
                {},
                make("label.row", {}, make("b", {}, say("title_label")), title),
                make(
                    "fieldset",
                    {},
                    make("legend", {}, say("quality")),
                    ...["draft", "normal", "best"].map(quality =>
                        choice(quality, make("span.soft", { "data-quality": quality })),
                    ),
                    choice("within", make("span", {}, minutes, " ", make("span.soft", {}, say("minutes_label")))),
                ),
                make("button.main", { type: "submit", click: action(start(wanted)) }, label),
                make("details", {}, make("summary", {}, say("command")), command(scene.command)),
            )
        );
        minutes.addEventListener("focus", () => (form.quality.value = "within"));
        function wanted() {
            const quality = form.quality.value;
            const time = quality === "within" ? { minutes: Number(minutes.value) } : { quality };
            return { title: title.value, ...time };
        }
        return form;
    }

    /** The stages, the photos, the map and the figures of the training. */
    function progressPart() {
        const stages = make("ol.stages");
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
            { type: "button", click: action(() => ask(`${address}/stop`, "POST", {})) },
            say("stop"),
        );
        const live = /** @type {HTMLIFrameElement} */ (
            make("iframe.viewer", { title: say("live"), allow: "fullscreen", hidden: true })
        );
        let listed = "";
        let drawn = 0; // the map that is shown
        update = (/** @type {any} */ now) => {
            const state = now.state;
            showStages(stages, now);
            showFigures(figures, curve, state);
            notesPart.hidden = !state.notes?.length;
            notes.replaceChildren(
                ...(state.notes ?? []).map((/** @type {string} */ line) => make("li", {}, told(line))),
            );
            if (live.hidden === now.has_page) {
                live.hidden = !now.has_page;
                live.src = now.has_page ? dressed(`${address}/live/`) : "about:blank";
            }
            mapBox.hidden = !now.map;
            if (now.map && now.map !== drawn) map.setAttribute("src", `${address}/map?${(drawn = now.map)}`);
            // The map is drawn anew when photos have been placed.
            const key = [now.map, ...(state.stages ?? []).map((/** @type {any} */ each) => each.stage)].join();
            if (key !== listed) {
                listed = key;
                ask(`${address}/photos`).then(
                    photos => showPhotos(strip, address, photos),
                    () => (listed = ""),
                );
            }
        };
        return [
            live,
            // The map is beside the stages, so that it is seen while it grows.
            make(
                "div.row.wide",
                {},
                make("section.card", {}, stages, make("div.row", {}, stop, make("span.soft", {}, say("stop_help")))),
                mapBox,
            ),
            strip,
            figures,
            curve,
            notesPart,
        ];
    }

    function stoppedPart(/** @type {any} */ scene) {
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
                make("button.main", { type: "button", click: action(start(wanted)) }, say("resume")),
                stages,
                make("details", {}, make("summary", {}, say("command")), command(scene.command)),
            ),
            ...againPart(scene),
        ];
    }

    function resultPart(/** @type {any} */ scene) {
        const result = scene.state.result;
        const fact = (/** @type {string} */ key, /** @type {string} */ value) => [
            make("dt", {}, say(key)),
            make("dd", {}, value),
        ];
        const site = `${address}/site/index.html`;
        const shownSite = dressed(site);
        const reports = Object.entries(result.reports).map(([kind, path]) =>
            make(
                "a.button.plain",
                { href: dressed(`${address}/made/${path}`), target: "_blank", rel: "noopener" },
                say(`report_${kind}`),
            ),
        );
        const film = make("section.card", { hidden: true });
        let filmed = 0;
        update = now => {
            if (now.film === filmed) return;
            filmed = now.film;
            showFilm(film, address, filmed);
        };
        const phone = make("section.card");
        showPhone(phone, site);
        return [
            make("iframe.viewer", {
                src: shownSite,
                title: say("viewer"),
                allow: "fullscreen; xr-spatial-tracking",
            }),
            make(
                "div.row",
                {},
                make("a.button.plain", { href: shownSite, target: "_blank", rel: "noopener" }, say("full")),
                ...reports,
                scene.edited > 0 && make("span.soft", {}, say("edited")),
            ),
            make(
                "dl.figures",
                {},
                ...fact("gaussians", result.gaussians.toLocaleString()),
                ...fact("size", bytes(result.bytes)),
                ...(result.psnr === null
                    ? []
                    : fact(result.aligned ? "psnr_aligned" : "psnr", `${result.psnr.toFixed(2)} dB`)),
                ...(result.seconds === null ? [] : fact("took", duration(result.seconds))),
            ),
            result.verdict.length > 0 &&
                make("section.card", {}, make("h2", {}, say("verdict")), ...verdictOf(result.verdict)),
            make(
                "section.card",
                {},
                make("h2", {}, say("download")),
                make("div.exports", {}, ...Object.keys(scene.exports).map(download)),
                make("details", {}, make("summary", {}, say("command")), ...Object.values(scene.exports).map(command)),
            ),
            film,
            phone,
            !scene.found && make("details.card", {}, make("summary", {}, say("again")), ...againPart(scene)),
        ].filter(part => part !== false);
    }

    function download(/** @type {string} */ kind) {
        const button = make(
            "button.plain",
            { type: "button", "aria-label": say("download_kind", kind.toUpperCase()) },
            kind.toUpperCase(),
        );
        const about = make("span", {}, say(`kind_${kind}`));
        button.addEventListener(
            "click",
            action(async () => {
                about.textContent = say("preparing");
                try {
                    await ask(`${address}/exports/${kind}`, "POST", {});
                    const link = make("a", { href: `${address}/exports/${kind}`, download: true });
                    link.click();
                } finally {
                    about.textContent = say(`kind_${kind}`);
                }
            }),
        );
        return make("div.export", {}, button, about);
    }

    const over = (/** @type {Event} */ event) => event.preventDefault();
    const drop = async (/** @type {DragEvent} */ event) => {
        event.preventDefault();
        if (event.dataTransfer && uploaded && shown !== "running" && (shown !== "upload" || uploads.get(name)?.error))
            add(await dropped(event.dataTransfer));
    };
    main.addEventListener("dragover", over, { signal: closed });
    main.addEventListener("drop", drop, { signal: closed });
    document.addEventListener("uploaded", () => (uploads.has(name) && shown === "upload" ? update?.({}) : refresh()), {
        signal: closed,
    });
    const showAnew = () => {
        shown = "";
        refresh();
    };
    document.addEventListener("edited", showAnew, { signal: closed });
    closed.addEventListener("abort", () => clearTimeout(timer));
    refresh();
}

/** The judgement, its reasons as a list, and what would help. */
function verdictOf(/** @type {string[]} */ lines) {
    const trimmed = lines.map(line => line.trim());
    const reasons = trimmed.filter(line => line.startsWith("- ")).map(line => make("li", {}, told(line.slice(2))));
    const [judgement, ...advice] = trimmed
        .filter(line => !line.startsWith("- "))
        .map(line => make("p", {}, told(line)));
    return [judgement, reasons.length > 0 && make("ul", {}, ...reasons), ...advice];
}

function factsOf(/** @type {any} */ facts) {
    const words = (/** @type {any} */ value) => {
        if (value === true) return say("given");
        if (typeof value !== "object") return told(String(value));
        const parts = Object.entries(value).map(([name, what]) => [
            name
                .split("/")
                .pop()
                ?.replace(/^(\d+)x(\d+)$/, "$1 × $2"),
            told(String(what)),
        ]);
        return parts.length === 1 && parts[0][1] === String(facts.photos)
            ? parts[0][0]
            : parts.map(part => part.join(": ")).join(", ");
    };
    const known = (/** @type {any} */ value) => value && words(value) !== "unknown";
    const rows = FACTS.filter(key => known(facts[key])).flatMap(key => [
        make("dt", {}, say(key)),
        make("dd", {}, words(facts[key])),
    ]);
    return [make("dl.facts", {}, ...rows)];
}

function showStages(/** @type {HTMLElement} */ list, /** @type {any} */ scene) {
    const { stages = [], now, steps } = scene.state;
    const done = new Map(stages.map((/** @type {any} */ each) => [each.stage, each]));
    const current = now?.stage;
    const names = STAGES.filter(
        name =>
            done.has(name) ||
            name === current ||
            (scene.status === "running" && STAGES.indexOf(name) > STAGES.indexOf(current)),
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
            } else if (name === current) {
                const training = name === "scene" && steps;
                const [count, total, left] = training
                    ? [steps.step, steps.iterations, steps.left]
                    : [now.done, now.total, now.left];
                const what = training ? say("step").toLowerCase() : told(now.what ?? "");
                const time = left ? ` – ${say("left", duration(left))}` : "";
                item.append(
                    make(
                        "span.soft",
                        {},
                        total
                            ? ` ${what} ${say("of", count.toLocaleString(), total.toLocaleString())}${time}`
                            : ` ${what}${time}`,
                    ),
                    make(
                        "progress",
                        total
                            ? { max: total, value: count, "aria-label": say(`stage_${name}`) }
                            : { "aria-label": say(`stage_${name}`) },
                    ),
                );
            }
            return item;
        }),
    );
}

function showFigures(
    /** @type {HTMLElement} */ figures,
    /** @type {HTMLElement} */ curve,
    /** @type {any} */ { steps, curve: points = [] },
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
    const values = points.map((/** @type {number[]} */ point) => Math.log(Math.max(point[1], 1e-9)));
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const last = points[points.length - 1][0];
    const way = values.map(
        (/** @type {number} */ value, /** @type {number} */ i) =>
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
    /** @type {{name: string, placed: boolean}[]} */ photos,
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

/** The film of the scene; `made`: its time, 0 if there is none. */
async function showFilm(/** @type {HTMLElement} */ card, /** @type {string} */ address, /** @type {number} */ made) {
    card.hidden = !made;
    if (!made) return;
    const { bytes: size, command: line } = await ask(`${address}/film`);
    const file = `${address}/film/file?${made}`;
    card.replaceChildren(
        make("h2", {}, say("film")),
        make("video.film", {
            src: file,
            controls: true,
            preload: "metadata",
            "aria-label": say("film"),
        }),
        make("div.row", {}, make("a.button.plain", { href: file, download: true }, say("film_download", bytes(size)))),
        line && command(line),
    );
}

/** The addresses of the scene for phones, with codes. */
async function showPhone(/** @type {HTMLElement} */ card, /** @type {string} */ site) {
    const { addresses } = await ask(`about?path=${encodeURIComponent(site)}`).catch(() => ({
        addresses: [],
    }));
    card.append(
        make("h2", {}, say("phone")),
        make(
            "div.row",
            {},
            ...(addresses.length
                ? addresses.map((/** @type {any} */ { url, code }) =>
                      make("div.phone", {}, make("img", { src: code, alt: "" }), make("a", { href: url }, url)),
                  )
                : [make("p.soft", {}, say("phone_how"))]),
        ),
    );
}
