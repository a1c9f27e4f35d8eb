// A finished scene: the viewer, the figures, downloads, the film, and addresses for phones.

import { action, ask, bytes, command, duration, make } from "./page.js";
import { againPart } from "./scene_start.js";
import { dressed, say, told } from "./text.js";

/** Shows a site of the downloads in another page. */
const EMBED =
    '<iframe src="https://example.org/scene/index.html" title="3D scene" allow="fullscreen; xr-spatial-tracking" style="width: 100%; aspect-ratio: 16 / 9; border: 0"></iframe>';

/** What a kind of file is called, if it is not the end of its name. @type {Record<string, string>} */
const NAMES = { glb: "glTF (splats)", mesh: "glTF (mesh)", points: "PLY (points)", ar: "USDZ (AR)" };

export function resultPart(
    /** @type {import("./scene.js").ScenePage} */ page,
    /** @type {import("./types.js").Scene} */ scene,
) {
    const { address } = page;
    const result = /** @type {import("./types.js").Result} */ (scene.state.result);
    const fact = (/** @type {string} */ key, /** @type {string} */ value) => [
        make("dt", {}, say(key)),
        make("dd", {}, value),
    ];
    const site = `${address}/site/index.html`;
    const shownSite = dressed(site);
    const reports = Object.entries(result.reports).map(([kind, path]) =>
        make(
            "a.button.plain",
            { href: dressed(`${scene.made}${path}`), target: "_blank", rel: "noopener" },
            say(`report_${kind}`),
        ),
    );
    const film = make("section.card", { hidden: true });
    let filmed = 0;
    page.update = now => {
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
        scene.verdict && make("section.card.verdict", {}, make("h2", {}, say("verdict")), ...verdictOf(scene.verdict)),
        make(
            "section.card",
            {},
            make("h2", {}, say("download")),
            make("div.exports", {}, ...Object.keys(scene.exports).map(kind => download(address, kind))),
            make("details", {}, make("summary", {}, say("command")), ...Object.values(scene.exports).map(command)),
        ),
        film,
        make("section.card", {}, make("h2", {}, say("embed")), make("p.soft", {}, say("embed_how")), command(EMBED)),
        phone,
        result.seconds !== null &&
            make("details.card", {}, make("summary", {}, say("again")), ...againPart(page, scene)),
    ].filter(part => part !== false && part !== null);
}

function download(/** @type {string} */ address, /** @type {string} */ kind) {
    const name = NAMES[kind] ?? kind.toUpperCase();
    const button = make("button.plain", { type: "button", "aria-label": say("download_kind", name) }, name);
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

/** The judgement, its reasons as a list, and what would help. */
function verdictOf(/** @type {import("./types.js").Verdict} */ { head, why, advice }) {
    const reasons = why.map(reason => make("li", {}, told(reason)));
    return [
        make("p", {}, told(head)),
        reasons.length > 0 && make("ul", {}, ...reasons),
        ...advice.map(line => make("p", {}, told(line))),
    ];
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

/** The addresses at which the scene can be looked at, for phones with codes. */
async function showPhone(/** @type {HTMLElement} */ card, /** @type {string} */ site) {
    /** @type {import("./types.js").About} */
    const { addresses, look } = await ask(`about?path=${encodeURIComponent(site)}`).catch(() => ({ addresses: [] }));
    card.append(
        make("h2", {}, say("phone")),
        make(
            "div.row",
            {},
            ...(addresses.length
                ? addresses.map(({ url, code }) =>
                      make("div.phone", {}, make("img", { src: code, alt: "" }), make("a", { href: url }, url)),
                  )
                : [make("p.soft", {}, say("phone_how"))]),
        ),
    );
    if (look) card.append(make("p.soft", {}, say("look")), command(new URL(look, location.href).href));
}
