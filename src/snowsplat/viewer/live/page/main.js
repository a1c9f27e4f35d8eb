// The page of the live viewer: what the server sends is shown, what the user does is sent.
import { Camera } from "./camera.js";
import { Connection } from "./connection.js";
import { DisplayPanel } from "./display.js";
import { byId, isDark, showLines } from "./elements.js";
import { Frustums } from "./frustums.js";
import { listen } from "./input.js";
import { inLanguage, switchLanguage, text, translate } from "./texts.js";
import { TrainingPanel } from "./training.js";
import { VideoPanel } from "./video.js";

const PAUSE = 20; // milliseconds between two messages about the camera or the settings
const NARROW = 700; // pixels: the panel then begins closed

/** @type {HTMLElement} */
const stage = byId("stage");
/** @type {ImageBitmapRenderingContext} */
const image = byId("image").getContext("bitmaprenderer");
/** @type {Camera | undefined} */
let camera;
/** @type {Frustums | undefined} */
let frustums;
/** @type {string} a name in `texts.js`; empty if all is well */
let notice = "connecting";
/** @type {Record<string, string>[]} about the scene, in each language */
let about = [];

// Sending. The newest state replaces one that waits; an image has the number of its view.

/** @type {Map<number, any>} views that were sent, and are not shown yet */
const views = new Map();
let number = 0;
/** @type {any} the view of the image that is shown */
let shown;
/** @type {{view: boolean, display: boolean}} what has changed since it was sent */
const changed = { view: false, display: false };
let waiting = false;

const size = () => {
    const ratio = Math.min(devicePixelRatio, 2);
    return {
        width: Math.round(stage.clientWidth * ratio),
        height: Math.round(stage.clientHeight * ratio),
    };
};

const flush = () => {
    waiting = false;
    if (changed.display) connection.send(display.message());
    if (changed.view && camera && stage.clientWidth && stage.clientHeight) {
        number += 1;
        const view = camera.view(size(), number);
        views.set(number, view);
        connection.send(view);
    }
    changed.view = changed.display = false;
};

/** @param {'view' | 'display'} what */
const change = what => {
    changed[what] = true;
    if (!waiting) setTimeout(flush, PAUSE);
    waiting = true;
};

const moved = () => {
    change("view");
    const at = camera?.photo ?? null;
    display.setAtPhoto(at !== null);
    describePhoto();
};

// Receiving

let newest = 0; // number of the newest image that has arrived
let thumbnails = 0; // number of those that have arrived
const AHEAD = 4; // thumbnails that may be on the way

const askForThumbnails = () => {
    if (byId("frustums").checked) connection.send({ type: "thumbnails", count: thumbnails + AHEAD });
};

const connection = new Connection({
    opened: () => {
        newest = thumbnails = 0;
        askForThumbnails();
        notice = "waitingForScene";
        changed.view = true;
        change("display");
        showNotice();
    },
    closed: () => {
        notice = "lost";
        showNotice();
    },
    told: message => {
        const { type } = message;
        if (type === "scene") showScene(message);
        else if (type === "training") training.show(message);
        else if (type === "curves") training.showCurves(message);
        else if (type === "about") {
            about = message.lines;
            showAbout();
        } else if (type === "key") video.add(message.entry);
        else if (type === "photo" && camera?.photo === message.index)
            byId("where").textContent = inLanguage(message.error);
    },
    image: async ({ number: arrived, view, blob }) => {
        newest = arrived;
        const bitmap = await createImageBitmap(blob).catch(() => undefined);
        connection.send({ type: "shown", number: arrived });
        if (!bitmap || arrived < newest) return;
        image.transferFromImageBitmap(bitmap);
        shown = views.get(view) ?? shown;
        for (const each of views.keys()) if (each < view) views.delete(each);
        drawFrustums();
        notice = "";
        showNotice();
    },
    thumbnail: async ({ index, blob }) => {
        thumbnails += 1;
        askForThumbnails();
        const bitmap = await createImageBitmap(blob).catch(() => undefined);
        if (bitmap) frustums?.thumbnails.set(index, bitmap);
        drawFrustums();
    },
});

/** @param {any} scene */
const showScene = scene => {
    byId("title").textContent = scene.title;
    if (!camera) {
        camera = new Camera(scene);
        frustums = new Frustums(byId("cameras"), scene.photos, scene.every, scene.length);
    }
    byId("photos").hidden = false;
    display.setBounds(scene.bounds);
    change("view");
};

const showNotice = () => {
    byId("notice").textContent = notice && text(notice);
    byId("notice").hidden = !notice;
};

const drawFrustums = () => {
    if (shown) frustums?.draw(shown, byId("frustums").checked && shown.photo === null);
};

const describePhoto = () => {
    const photo = camera && camera.photo !== null ? camera.scene.photos[camera.photo] : undefined;
    byId("where").textContent = photo ? text(photo.heldOut ? "heldOut" : "at", { name: photo.name }) : text("nowhere");
};

// What the user does

/** @param {number} by */
const stepPhoto = by => {
    if (!camera) return;
    const { length } = camera.scene.photos;
    const next = camera.photo === null ? lastPhoto : (camera.photo + by + length) % length;
    goToPhoto(next);
};

let lastPhoto = 0; // the photo to which Next and Previous go from elsewhere
/** @param {number} index */
const goToPhoto = index => {
    lastPhoto = index;
    camera?.goTo(index);
    moved();
};

const showTheme = () => {
    byId("theme").setAttribute("aria-pressed", String(isDark()));
    drawFrustums();
};

const switchTheme = () => {
    document.documentElement.dataset.theme = isDark() ? "light" : "dark";
    showTheme();
};
// The page of the studio says its colours in the address.
const colours = new URLSearchParams(location.search).get("theme") ?? "";
// The page of the studio, which shows this one, has the buttons.
byId("theme").hidden = byId("language").hidden = colours !== "";
if (["light", "dark"].includes(colours)) document.documentElement.dataset.theme = colours;

/** @param {boolean} open */
const openPanel = open => {
    byId("panel").hidden = !open;
    byId("open").hidden = open;
};

const display = new DisplayPanel(() => change("display"));
const send = (/** @type {object} */ message) => connection.send(message);
const training = new TrainingPanel(send);
const video = new VideoPanel(send);

listen(stage, {
    camera: () => camera,
    moved,
    clicked: (x, y) => {
        stage.focus();
        const index = frustums?.at(x, y);
        if (index !== undefined) goToPhoto(index);
    },
    hovered: (x, y) => {
        const index = frustums?.at(x, y);
        stage.style.cursor = index === undefined ? "" : "pointer";
        byId("tip").hidden = index === undefined;
        if (frustums && index !== undefined) {
            byId("tip").textContent = frustums.photos[index].name;
            Object.assign(byId("tip").style, { left: `${x}px`, top: `${y}px` });
        }
        if (!frustums || frustums.pointed === index) return;
        frustums.pointed = index;
        drawFrustums();
    },
    keys: {
        f: () => {
            camera?.frame(size());
            moved();
        },
        r: () => {
            camera?.reset();
            moved();
        },
        n: () => stepPhoto(1),
        p: () => stepPhoto(-1),
        l: switchTheme,
        " ": () => training.togglePause(),
    },
});
byId("next").onclick = () => stepPhoto(1);
byId("previous").onclick = () => stepPhoto(-1);
byId("frustums").onchange = () => {
    askForThumbnails();
    drawFrustums();
};
byId("theme").onclick = switchTheme;
byId("language").onclick = () => {
    switchLanguage();
    showTexts();
};
byId("open").onclick = () => openPanel(true);
byId("close").onclick = () => openPanel(false);
new ResizeObserver(() => {
    change("view");
    drawFrustums();
}).observe(stage);
matchMedia("(prefers-color-scheme: light)").addEventListener("change", showTheme);
// A list that was chosen with the mouse returns the keyboard to the scene.
byId("mode").addEventListener("change", () => byId("mode").matches(":focus-visible") || stage.focus());

const showAbout = () => {
    byId("about").hidden = !about.length;
    showLines(byId("lines"), about.map(inLanguage));
};
const showTexts = () => {
    translate();
    byId("language").textContent = text("other");
    showNotice();
    training.show();
    display.describe();
    video.show();
    describePhoto();
    showAbout();
};
showTexts();
showTheme();
openPanel(innerWidth >= NARROW);
