// The start page, and which page is shown.

import { action, ask, make, notice, reasonOf, showStatus } from "./page.js";
import { ScenePage } from "./scene.js";
import { upload } from "./scene_upload.js";
import { chosenLanguage, chosenTheme, say, speak } from "./text.js";
import { chosen, dropped, titleOf } from "./upload.js";

// Documents and programs: a scene of nothing else would have no photos.
const NO_PHOTO = /\.(txt|md|pdf|docx?|xlsx?|pptx?|odt|csv|html?|css|js|py|ipynb|exe|dmg|msi)$/i;

const main = /** @type {HTMLElement} */ (document.getElementById("main"));
let closing = new AbortController();

function route() {
    closing.abort();
    closing = new AbortController();
    notice("");
    const name = decodeURIComponent(location.hash.slice(1));
    if (name) new ScenePage(main, name, closing.signal);
    else showStart(closing.signal);
    main.scrollIntoView();
}

function showStart(/** @type {AbortSignal} */ closed) {
    document.title = "snowsplat studio";
    const files = make("input", { type: "file", multiple: true, change: picked });
    const folder = make("input", { type: "file", webkitdirectory: true, change: picked });
    const touch = matchMedia("(pointer: coarse)").matches; // phones cannot drop or choose a folder
    const zone = make(
        "section.drop",
        {},
        make("h1", {}, say("title")),
        make("p", {}, say(touch ? "give" : "drop")),
        make("p.soft", {}, say("advice")),
        make(
            "div.row",
            {},
            make("label.button.main", {}, say("choose_files"), files),
            !touch && make("label.button.plain", {}, say("choose_folder"), folder),
            make("button.plain", { type: "button", click: action(example) }, say("try_example")),
        ),
        make("p.soft", {}, say("private")),
    );
    const grid = make("div.grid");
    const kept = make("p.soft");
    main.replaceChildren(zone, machinePart(), make("h2", {}, say("recent")), grid, kept);

    const over = (/** @type {boolean} */ on) => (/** @type {Event} */ event) => {
        event.preventDefault();
        zone.classList.toggle("over", on);
    };
    main.addEventListener("dragover", over(true), { signal: closed });
    main.addEventListener("dragleave", over(false), { signal: closed });
    main.addEventListener(
        "drop",
        event => {
            over(false)(event);
            if (event.dataTransfer) dropped(event.dataTransfer).then(begin);
        },
        { signal: closed },
    );

    Promise.all([ask("scenes"), ask("about")]).then(
        ([scenes, about]) => {
            grid.replaceChildren(...(scenes.length ? scenes.map(tile) : [make("p.soft", {}, say("none"))]));
            kept.textContent = say("kept", about.folder);
        },
        error => notice(reasonOf(error)),
    );
}

function tile(/** @type {any} */ scene) {
    const address = `scenes/${encodeURIComponent(scene.name)}`;
    return make(
        "a.tile",
        { href: `#${encodeURIComponent(scene.name)}` },
        scene.picture ? make("img", { src: `${address}/picture`, alt: "", loading: "lazy" }) : make("div.empty"),
        make("b", {}, scene.title),
        showStatus(make("span.soft"), scene.status, scene.grade),
        scene.created &&
            make("span.soft", {}, new Date(scene.created).toLocaleDateString(document.documentElement.lang)),
    );
}

function picked(/** @type {Event} */ event) {
    const input = /** @type {HTMLInputElement} */ (event.target);
    if (input.files) begin(chosen(input.files));
}

async function begin(/** @type {import("./upload.js").Item[]} */ items) {
    if (!items.length) return;
    if (items.every(item => NO_PHOTO.test(item.path))) {
        notice(say("no_photos"));
        return;
    }
    try {
        const { name } = await ask("scenes", "POST", { title: titleOf(items) });
        upload(name, items);
        location.hash = encodeURIComponent(name);
    } catch (error) {
        notice(reasonOf(error));
    }
}

/** A scene whose photos are rendered first; it begins at once. */
async function example() {
    const { name } = await ask("scenes", "POST", { title: say("example"), example: true });
    location.hash = encodeURIComponent(name);
}

/** Chooses a folder of the machine where the studio runs. */
function machinePart() {
    const path = /** @type {HTMLInputElement} */ (
        make("input", {
            type: "text",
            autocomplete: "off",
            spellcheck: "false",
            "aria-label": say("path"),
            placeholder: say("path"),
        })
    );
    const list = make("div.folders");
    const use = async (/** @type {string} */ where) => {
        const { name } = await ask("scenes", "POST", { path: where });
        location.hash = encodeURIComponent(name);
    };
    const look = async (/** @type {string} */ where) => {
        const found = await ask(`browse?path=${encodeURIComponent(where)}`);
        path.value = found.path;
        const inside = (/** @type {string} */ name) => `${found.path.replace(/[/\\]$/, "")}/${name}`;
        list.replaceChildren(
            make("button.plain", { type: "button", click: action(() => look(found.parent)) }, `↑ ${say("up")}`),
            ...(found.photos > 0
                ? [
                      make(
                          "button.main",
                          { type: "button", click: action(() => use(found.path)) },
                          say("use_this", found.photos),
                      ),
                  ]
                : []),
            ...found.folders.map((/** @type {string} */ name) =>
                make("button.plain", { type: "button", click: action(() => look(inside(name))) }, `${name}/`),
            ),
            ...found.files.map((/** @type {string} */ name) =>
                make("button.plain", { type: "button", click: action(() => use(inside(name))) }, name),
            ),
        );
    };
    return make(
        "details.card",
        {},
        make("summary", {}, say("on_machine")),
        make(
            "form.row",
            {},
            path,
            make("button.plain", { type: "button", click: action(() => look(path.value)) }, say("browse")),
            make("button.main", { type: "submit", click: action(() => use(path.value)) }, say("use")),
        ),
        list,
    );
}

// Language and colours are kept in the browser.

const themes = ["auto", "light", "dark"];

function dress() {
    document.documentElement.dataset.theme = chosenTheme();
    speak(chosenLanguage());
    const theme = /** @type {HTMLElement} */ (document.getElementById("theme"));
    // The pages inside this one have no buttons of their own.
    for (const frame of document.querySelectorAll("iframe")) {
        const inner = frame.contentDocument?.documentElement;
        if (inner) inner.dataset.theme = chosenTheme();
    }
    theme.textContent = `◐ ${say(chosenTheme())}`;
    theme.ariaLabel = say("colours", say(chosenTheme()));
    /** @type {HTMLElement} */ (document.getElementById("language")).textContent = say("other");
}

document.getElementById("theme")?.addEventListener("click", () => {
    localStorage.setItem("theme", themes[(themes.indexOf(chosenTheme()) + 1) % themes.length]);
    dress();
});
document.getElementById("language")?.addEventListener("click", () => {
    localStorage.setItem("language", chosenLanguage() === "zh" ? "en" : "zh");
    dress();
    route();
});
dress();
addEventListener("hashchange", () => {
    route();
    main.focus({ preventScroll: true }); // what had the focus is gone
});
route();
