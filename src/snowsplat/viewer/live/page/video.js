// The part of the panel with the views for a video, as `snowsplat render --path` reads them.
import { byId } from "./elements.js";
import { text } from "./texts.js";

export const FILE = "cameras.json";
const MOST = 10000;

export class VideoPanel {
    /** @param {(message: object) => void} send */
    constructor(send) {
        /** @type {object[]} entries of the file, from the server */
        this.entries = [];
        byId("store").onclick = () => send({ type: "key" });
        byId("remove").onclick = () => {
            this.entries.pop();
            this.show();
        };
        byId("download").onclick = () => this.download();
    }

    /** @param {object} entry */
    add(entry) {
        if (this.entries.length < MOST) this.entries.push(entry);
        this.show();
    }

    show() {
        const count = this.entries.length;
        byId("remove").disabled = count === 0;
        byId("download").disabled = count < 2;
        byId("stored").textContent = count ? text("stored", { count }) : text("none");
    }

    download() {
        const named = this.entries.map((entry, id) => ({
            ...entry,
            id,
            img_name: `key_${String(id).padStart(3, "0")}`,
        }));
        const url = URL.createObjectURL(new Blob([JSON.stringify(named, null, 1)], { type: "application/json" }));
        Object.assign(document.createElement("a"), { href: url, download: FILE }).click();
        setTimeout(() => URL.revokeObjectURL(url), 10000);
    }
}
