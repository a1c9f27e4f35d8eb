// Elements, requests and numbers, for all parts of the page.

import { say, told } from "./text.js";

/**
 * The type of an element with this tag: "input.wide" is an HTMLInputElement.
 * @template {string} T
 * @typedef {T extends `${infer Name}.${string}` ? ElementOf<Name>
 *     : T extends keyof HTMLElementTagNameMap ? HTMLElementTagNameMap[T] : HTMLElement} ElementOf
 */

/**
 * A new element.
 * @template {string} T
 * @param {T} tag name, with classes: "p.soft"
 * @param {Record<string, unknown>} [attributes] functions are listeners: {click: …}
 * @param {...(Node | string | null | undefined | false)} children
 * @returns {ElementOf<T>}
 */
export function make(tag, attributes = {}, ...children) {
    const [name, ...classes] = tag.split(".");
    const element = document.createElement(name);
    element.classList.add(...classes);
    for (const [key, value] of Object.entries(attributes)) {
        if (typeof value === "function") element.addEventListener(key, /** @type {EventListener} */ (value));
        else if (value === true) element.setAttribute(key, "");
        else if (value !== false && value !== null && value !== undefined) element.setAttribute(key, String(value));
    }
    element.append(...children.filter(child => child !== null && child !== undefined && child !== false));
    return /** @type {ElementOf<T>} */ (element);
}

/** A button with a text. */
export const button = (/** @type {string} */ key, /** @type {(event: any) => void} */ click) =>
    /** @type {HTMLButtonElement} */ (make("button", { type: "button", click }, say(key)));

/** A line about a state: green only if it is a good one. `grade`: of a finished scene, null if nobody knows. */
export function showStatus(
    /** @type {HTMLElement} */ element,
    /** @type {string} */ status,
    /** @type {string | null | undefined} */ grade,
) {
    element.textContent = say(status);
    element.dataset.status = status;
    if (grade) element.append(" ", make("span.badge", { "data-grade": grade }, say(`grade_${grade}`)));
    return element;
}

/** An error that the server has told in one line. */
export class Refused extends Error {
    /**
     * @param {string} message
     * @param {number} status
     * @param {any} answer
     */
    constructor(message, status, answer) {
        super(message);
        this.status = status;
        this.answer = answer;
    }
}

/** Why a request failed, for people. */
export const reasonOf = (/** @type {unknown} */ error) => (error instanceof Refused ? error.message : say("offline"));

/**
 * The JSON answer of the server.
 * @param {string} path relative to the page
 * @param {string} [method]
 * @param {any} [body] an object is sent as JSON
 * @returns {Promise<any>}
 */
export async function ask(path, method = "GET", body = undefined) {
    const raw = body === undefined || body instanceof Blob;
    const response = await fetch(path, { method, body: raw ? body : JSON.stringify(body) });
    const answer = await response.json().catch(() => ({}));
    // A studio that was started again has another token, and answers this one without JSON.
    if (response.status === 404 && !answer.error) throw new Error("this is no answer of the studio");
    if (!response.ok) throw new Refused(told(answer.error ?? `${response.status}`), response.status, answer);
    return answer;
}

/** @param {string} text shown for some seconds; "" hides it */
export function notice(text) {
    const element = /** @type {HTMLElement} */ (document.getElementById("notice"));
    element.textContent = text;
    element.hidden = !text;
    clearTimeout(hiding);
    hiding = setTimeout(() => (element.hidden = true), 12000);
}
/** @type {ReturnType<typeof setTimeout> | undefined} */
let hiding;

/**
 * Gives the focus of the keyboard back if its element was disabled or is gone: to that element, to what
 * has its name now, to what is at its place, or to the page.
 */
function focusAgain(/** @type {HTMLElement} */ last, /** @type {HTMLElement | null} */ place) {
    const main = /** @type {HTMLElement} */ (document.getElementById("main"));
    if (document.activeElement !== document.body && document.activeElement !== main) return;
    const name = (/** @type {HTMLElement} */ each) => [each.textContent, each.ariaLabel].join();
    const all = /** @type {HTMLElement[]} */ ([...main.querySelectorAll(last.tagName)]);
    const same = last.isConnected ? last : all.find(each => name(each) === name(last));
    const near = place?.isConnected && place.querySelector("button");
    (same || near || main).focus({ preventScroll: true });
}

/** Runs an action of a button, which is disabled meanwhile; tells an error. */
export function action(/** @type {() => Promise<any>} */ run) {
    return async (/** @type {Event} */ event) => {
        const button = /** @type {HTMLButtonElement} */ (event.currentTarget);
        const focused = /** @type {HTMLElement} */ (document.activeElement);
        const place = focused.parentElement;
        event.preventDefault();
        button.disabled = true;
        try {
            await run();
        } catch (error) {
            notice(reasonOf(error));
        } finally {
            button.disabled = false;
            if (focused !== document.body) focusAgain(focused, place);
        }
    };
}

/** A command line that does the same, to copy. */
export function command(/** @type {string} */ line) {
    return make(
        "div.command",
        {},
        make("code", { tabindex: 0 }, line), // the keyboard scrolls it
        // Browsers give the clipboard only to pages of this machine, or with https.
        navigator.clipboard && make("button.plain", { type: "button", click: copy }, say("copy")),
    );

    async function copy(/** @type {any} */ { currentTarget: button }) {
        await navigator.clipboard.writeText(line);
        button.textContent = say("copied");
        setTimeout(() => (button.textContent = say("copy")), 3000);
    }
}

/** @param {number} count of bytes */
export function bytes(count) {
    for (const [unit, name] of /** @type {[number, string][]} */ ([
        [1e9, "GB"],
        [1e6, "MB"],
        [1e3, "kB"],
    ])) {
        if (count >= unit) return `${(count / unit).toFixed(count < 10 * unit ? 1 : 0)} ${name}`;
    }
    return `${count} B`;
}

/** @param {number} seconds */
export function duration(seconds) {
    if (seconds < 60) return say("seconds", Math.max(1, Math.round(seconds)));
    if (seconds < 3600) return say("minutes", Math.round(seconds / 60));
    return say("hours", (seconds / 3600).toFixed(1));
}
