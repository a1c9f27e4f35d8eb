// The photos of a scene that has not begun: what is wrong with them, and which are left out.

import { action, ask, make } from "./page.js";
import { say, told } from "./text.js";

/**
 * Fills an element with the photos; those with a mark come first.
 * @param {import("./scene.js").ScenePage} page
 * @param {HTMLElement} element
 * @param {() => void} changed is called after a photo was left out or taken back
 */
export async function showGiven(page, element, changed) {
    /** @type {import("./types.js").Given[]} */
    const photos = await ask(`${page.address}/given`);
    element.hidden = photos.length === 0;
    if (element.hidden) return;
    const head = make("p.soft", { role: "status" }, say("checking"));
    const list = make("div.given");
    const tiles = new Map(photos.map(photo => [photo.name, tile(page, photo, changed)]));
    list.replaceChildren(...tiles.values());
    element.replaceChildren(head, list);
    /** @type {Record<string, import("./types.js").Told>} */
    const marks = (await ask(`${page.address}/marks`, "POST").catch(() => ({ marks: {} }))).marks;
    const marked = Object.entries(marks).filter(([name]) => tiles.has(name));
    for (const [name, why] of marked) {
        const photo = /** @type {HTMLElement} */ (tiles.get(name));
        photo.append(make("span.mark", {}, told(why)));
        if (page.uploaded) photo.ariaLabel = `${told(why)} ${say("leave_out", name)}`;
    }
    list.prepend(...marked.map(([name]) => /** @type {HTMLElement} */ (tiles.get(name))));
    const count = marked.length ? say("marked", marked.length, photos.length) : say("unmarked");
    head.textContent = page.uploaded ? `${count} ${say("click_photo")}` : count;
}

/**
 * @param {import("./scene.js").ScenePage} page
 * @param {import("./types.js").Given} photo
 * @param {() => void} changed
 */
function tile(page, photo, changed) {
    const path = photo.name.split("/").map(encodeURIComponent).join("/");
    const picture = make("img", { src: `${page.address}/given/${path}`, alt: photo.name, loading: "lazy" });
    picture.addEventListener("error", () => picture.classList.add("damaged"));
    if (!page.uploaded) return make("div", { title: photo.name }, picture);
    const button = make("button", { type: "button", title: photo.name, click: action(turn) }, picture);
    const show = () => button.setAttribute("aria-pressed", String(photo.out));
    button.ariaLabel = say("leave_out", photo.name);
    show();
    return button;

    async function turn() {
        await ask(`${page.address}/given`, "POST", { name: photo.name, out: !photo.out });
        photo.out = !photo.out;
        show();
        changed();
    }
}
