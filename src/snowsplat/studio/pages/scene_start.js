// The start of a job: what the photos are, and the form.

import { action, ask, command, duration, make, reasonOf } from "./page.js";
import { showGiven } from "./scene_photos.js";
import { moreFiles } from "./scene_upload.js";
import { say, told } from "./text.js";

const FACTS = ["photos", "sizes", "cameras", "with_gps", "videos", "poses", "not_used", "doubtful"];

/** What the photos are, and a form that starts the job. */
export function startPart(
    /** @type {import("./scene.js").ScenePage} */ page,
    /** @type {import("./types.js").Scene} */ scene,
) {
    const facts = make("section.card", {}, make("p", {}, say("looking")));
    const form = startForm(page, scene, say("start"));
    const photos = make("section.card", { hidden: true });
    form.hidden = true;
    look();
    if (!scene.found) showGiven(page, photos, look).catch(() => (photos.hidden = true));
    return [facts, form, photos];

    async function look() {
        try {
            /** @type {import("./types.js").Arrived[]} */
            const files = page.uploaded ? await ask(`${page.address}/uploads`) : [];
            const parts = files.filter(file => file.received < file.size).length;
            const found = !page.uploaded || files.length > parts ? await ask(`${page.address}/survey`, "POST") : null;
            if (page.closed.aborted || page.shown !== "new") return;
            if (found?.scene) return await start(page, () => ({ title: scene.title }))();
            facts.replaceChildren(...(found ? factsOf(found.facts) : [make("p", {}, say("no_files"))]));
            if (found?.few) facts.append(warning(found.few));
            if (parts) facts.append(make("p.bad", { role: "alert" }, say("not_arrived", parts)));
            if (page.uploaded) facts.append(moreFiles(page));
            form.hidden = !found;
            for (const [quality, seconds] of Object.entries(found?.seconds ?? {})) {
                const time = form.querySelector(`[data-quality=${quality}]`);
                if (time) time.textContent = say("about_time", duration(Number(seconds)));
            }
        } catch (error) {
            facts.replaceChildren(make("p.bad", { role: "alert" }, reasonOf(error)));
            if (page.uploaded) facts.append(moreFiles(page));
        }
    }
}

/** What to know before the time is spent. */
const warning = (/** @type {import("./types.js").Few} */ { grade, text, advice }) =>
    make("p", { role: "alert" }, make("span.badge", { "data-grade": grade }, told(text)), " ", told(advice));

/** Sends the form, or the same wishes again. */
export const start =
    (/** @type {import("./scene.js").ScenePage} */ page, /** @type {() => object} */ wanted) => async () => {
        await ask(`${page.address}/start`, "POST", wanted());
        await page.refresh();
    };

/** With more photos, or another quality. */
export function againPart(
    /** @type {import("./scene.js").ScenePage} */ page,
    /** @type {import("./types.js").Scene} */ scene,
) {
    return [...(page.uploaded ? [moreFiles(page)] : []), startForm(page, scene, say("again"))];
}

function startForm(
    /** @type {import("./scene.js").ScenePage} */ page,
    /** @type {import("./types.js").Scene} */ scene,
    /** @type {string} */ label,
) {
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
    const title = /** @type {HTMLInputElement} */ (make("input", { type: "text", value: scene.title, maxlength: 80 }));
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
            make("button.main", { type: "submit", click: action(start(page, wanted)) }, label),
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

/**
 * @param {import("./types.js").Fact} value
 * @returns {value is import("./types.js").Told | number | boolean}
 */
const isText = value => typeof value !== "object" || "zh" in value;

function factsOf(/** @type {import("./types.js").Survey["facts"]} */ facts) {
    const words = (/** @type {import("./types.js").Fact} */ value) => {
        if (value === true) return say("given");
        if (isText(value)) return told(value);
        const parts = Object.entries(value).map(([name, what]) => [
            name
                .split("/")
                .pop()
                ?.replace(/^(\d+)x(\d+)$/, "$1 × $2"),
            told(what),
        ]);
        return parts.length === 1 && parts[0][1] === String(facts.photos)
            ? parts[0][0]
            : parts.map(part => part.join(": ")).join(", ");
    };
    const known = (/** @type {import("./types.js").Fact | undefined} */ value) => value && words(value) !== "unknown";
    const rows = FACTS.filter(key => known(facts[key])).flatMap(key => [
        make("dt", {}, say(key)),
        make("dd", {}, words(facts[key])),
    ]);
    return [make("dl.facts", {}, ...rows)];
}
