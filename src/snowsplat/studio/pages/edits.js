// What an edit of a scene is: a byte per Gaussian, which says whether it is selected or deleted; how the
// scene is turned, a quaternion wxyz; its size, initial view and annotations; the box that selects, its
// lower and its upper corner; and what undoes a change.

import { product, UNTURNED } from "./turning.js";

export const SELECTED = 1;
export const DELETED = 2;

const STEPS = 40; // that can be undone
const MEMORY = 1 << 28; // bytes of the states of these steps; a large scene has fewer steps

/** @typedef {{title: string, text: string, view: number[]}} Note its view is position, target, field of view, aspect */
/** @typedef {{state: Uint8Array, turn: number[], scale: number, start: number[] | null, notes: Note[], box: number[][]}} Edit not changed, but replaced */

export class Edits {
    /**
     * @param {number} count of Gaussians
     * @param {Note[]} notes
     * @param {number[][]} box
     */
    constructor(count, notes = [], box = []) {
        /** @type {Edit} */
        this.present = {
            state: new Uint8Array(count),
            turn: UNTURNED,
            scale: 1,
            start: null,
            notes,
            box,
        };
        /** @type {Edit[]} */
        this.past = [];
        /** @type {Edit[]} */
        this.future = [];
        this.#steps = Math.max(1, Math.min(STEPS, Math.floor(MEMORY / count)));
    }
    #steps;
    #last = "";

    /**
     * A step that can be undone.
     * @param {Partial<Edit>} changes
     * @param {string} what steps with the same name, one after the other, are one step: typing in a field, dragging
     */
    change(changes, what = "") {
        if (!what || what !== this.#last) this.past.push(this.present);
        if (this.past.length > this.#steps) this.past.shift();
        this.future.length = 0;
        this.#last = what;
        this.present = { ...this.present, ...changes };
    }

    /** Changes the bytes; a change of nothing is no step. */
    #mark(/** @type {(byte: number, i: number) => number} */ marked) {
        const { state } = this.present;
        const next = state.map(marked);
        for (let i = 0; i < next.length; i++) if (next[i] !== state[i]) return this.change({ state: next });
    }

    /** Turns the scene further. */
    turnBy(/** @type {number[]} */ quaternion) {
        this.change({ turn: product(quaternion, this.present.turn) });
    }

    /**
     * Selects what was found. What is deleted is never selected.
     * @param {ArrayLike<number>} found a byte per Gaussian
     * @param {string} mode "replace", "add" or "remove"
     */
    select(found, mode) {
        this.#mark((byte, i) => {
            if (byte === DELETED) return byte;
            if (mode === "replace") return found[i];
            return found[i] ? Number(mode === "add") : byte;
        });
    }

    invert() {
        this.#mark(byte => (byte === DELETED ? byte : byte ^ SELECTED));
    }

    delete() {
        this.#mark(byte => (byte === SELECTED ? DELETED : byte));
    }

    undo() {
        this.#go(this.past, this.future);
    }

    redo() {
        this.#go(this.future, this.past);
    }

    #go(/** @type {Edit[]} */ from, /** @type {Edit[]} */ to) {
        const next = from.pop();
        if (!next) return;
        to.push(this.present);
        this.present = next;
        this.#last = "";
    }

    /** The numbers of Gaussians that are not selected, selected and deleted. */
    counts() {
        const found = [0, 0, 0];
        for (const byte of this.present.state) found[byte]++;
        return found;
    }

    /** A bit per Gaussian, the lowest bit of a byte first: whether it is deleted. In base64. */
    deleted() {
        const { state } = this.present;
        const bytes = new Uint8Array(Math.ceil(state.length / 8));
        state.forEach((byte, i) => {
            if (byte === DELETED) bytes[i >> 3] |= 1 << (i & 7);
        });
        let text = "";
        for (let at = 0; at < bytes.length; at += 1 << 14)
            text += String.fromCharCode(...bytes.subarray(at, at + (1 << 14)));
        return btoa(text);
    }
}
