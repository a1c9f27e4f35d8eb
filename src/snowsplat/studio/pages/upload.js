// Files that are dropped or chosen, and their upload in parts, which resumes.

import { ask, Refused } from "./page.js";

const PART = 4 << 20; // bytes
const AT_ONCE = 3; // files

/** @typedef {{path: string, file: File}} Item */

/**
 * All files of a drop, also those in folders.
 * @param {DataTransfer} transfer
 * @returns {Promise<Item[]>}
 */
export async function dropped(transfer) {
    // They can be read only now; the rest may wait.
    const entries = [...transfer.items].map(item => item.webkitGetAsEntry()).filter(entry => entry !== null);
    return (await Promise.all(entries.map(entry => inside(entry, "")))).flat();
}

/**
 * @param {FileSystemEntry} entry
 * @param {string} prefix
 * @returns {Promise<Item[]>}
 */
async function inside(entry, prefix) {
    const path = prefix + entry.name;
    if (entry.name.startsWith(".")) return [];
    if (entry.isFile) {
        const file = await new Promise((done, fail) => /** @type {FileSystemFileEntry} */ (entry).file(done, fail));
        return [{ path, file }];
    }
    const reader = /** @type {FileSystemDirectoryEntry} */ (entry).createReader();
    const found = [];
    for (;;) {
        const some = await new Promise((done, fail) => reader.readEntries(done, fail));
        if (some.length === 0) return found;
        for (const each of some) found.push(...(await inside(each, `${path}/`)));
    }
}

/** @param {FileList} files of an input element @returns {Item[]} */
export function chosen(files) {
    return [...files]
        .map(file => ({ path: file.webkitRelativePath || file.name, file }))
        .filter(item => !item.path.split("/").some(name => name.startsWith(".")));
}

/** A title for what was dropped: that of the folder or of a single file, else the date of the first one. */
export function titleOf(/** @type {Item[]} */ items) {
    const first = items[0].path.split("/");
    if (first.length > 1) return first[0];
    if (items.length === 1) return first[0].replace(/\.[^.]+$/, "");
    const date = new Date(timeOf(items[0].file));
    return new Date(date.getTime() - 60000 * date.getTimezoneOffset()).toISOString().slice(0, 10);
}

/** When a file was changed last: milliseconds since 1970. */
const timeOf = (/** @type {File} */ file) => Math.max(0, Math.floor(file.lastModified));

/** Tells a file from others of the same name. */
const nameOf = (/** @type {string} */ path, /** @type {number} */ size, /** @type {number} */ modified) =>
    `${path} ${size} ${modified}`;

/** The upload of files to a scene; `changed` is called after each part. */
export class Upload {
    /**
     * @param {string} scene its address
     * @param {Item[]} items
     * @param {() => void} changed
     */
    constructor(scene, items, changed) {
        this.scene = scene;
        this.items = items;
        this.changed = changed;
        this.total = items.reduce((sum, item) => sum + item.file.size, 0);
        /** @type {Map<Item, number>} */
        this.sent = new Map();
        this.finished = 0; // files
        this.began = Date.now();
        this.before = 0; // bytes that had arrived earlier
        this.offline = false;
        this.error = "";
    }

    get bytes() {
        return [...this.sent.values()].reduce((sum, count) => sum + count, 0);
    }

    /** Seconds that are left at the mean speed. */
    get left() {
        const now = this.bytes;
        return ((this.total - now) * (Date.now() - this.began)) / 1000 / Math.max(1, now - this.before);
    }

    /** Sends all files; true if all have arrived. */
    async run() {
        /** @type {any[]} */
        const arrived = await ask(`${this.scene}/uploads`).catch(() => []);
        const known = new Map(arrived.map(each => [nameOf(each.path, each.size, each.modified), each.received]));
        for (const item of this.items) {
            const count = known.get(nameOf(item.path, item.file.size, timeOf(item.file))) ?? 0;
            this.sent.set(item, count);
            this.before += count;
        }
        const waiting = [...this.items];
        const one = async () => {
            for (let item; !this.error && (item = waiting.shift()); ) await this.#send(item);
        };
        await Promise.all(Array.from({ length: AT_ONCE }, one));
        return !this.error;
    }

    /** @param {Item} item */
    async #send({ path, file }) {
        const item = /** @type {Item} */ (this.items.find(each => each.file === file));
        let start = this.sent.get(item) ?? 0;
        do {
            const query = new URLSearchParams({
                path,
                size: String(file.size),
                modified: String(timeOf(file)),
                start: String(start),
            });
            try {
                const part = file.slice(start, start + PART);
                start = (await ask(`${this.scene}/uploads?${query}`, "PUT", part)).received;
                this.offline = false;
            } catch (error) {
                if (error instanceof Refused && error.status === 409) {
                    start = error.answer.received;
                } else if (error instanceof Refused) {
                    this.error = error.message;
                    this.changed();
                    return;
                } else {
                    this.offline = true; // the server or the network is away
                    await new Promise(done => setTimeout(done, 2000));
                }
            }
            this.sent.set(item, start);
            this.changed();
        } while (start < file.size);
        this.finished += 1;
        this.changed();
    }
}
