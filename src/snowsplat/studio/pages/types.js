// The types of what the server answers; see `studio/app.py` and the state that a job writes.

/**
 * A scene of the library; the answer of GET /scenes/NAME.
 * @typedef {object} Scene
 * @property {string} name
 * @property {string} title
 * @property {string} folder
 * @property {boolean} found it is of the command line
 * @property {string[]} inputs
 * @property {string | null} quality
 * @property {number | null} minutes
 * @property {string} status see `status_of`
 * @property {Verdict | null} verdict on a finished scene
 * @property {State} state
 * @property {boolean} has_page whether the page of a training can be seen
 * @property {number} edited the time of the last edit; 0 if there is none
 * @property {number} film its time; 0 if there is none
 * @property {number} map its time; 0 if there is none
 * @property {string} command a command line that does the same
 * @property {string} made the address of its reports
 * @property {Record<string, string>} exports command lines by format
 */

/**
 * The progress of a job, and its result.
 * @typedef {object} State
 * @property {Stage[]} [stages] the finished ones
 * @property {Now} [now]
 * @property {Steps} [steps]
 * @property {[number, number][]} [curve] steps and losses
 * @property {Told[]} [notes]
 * @property {Told} [error]
 * @property {Result} [result]
 */

/** @typedef {{name: string, out: boolean}} Given a photo of a scene that has not begun, and whether it is left out */
/** @typedef {{stage: string, lines: Told[], seconds: number, again: boolean}} Stage */
/** @typedef {{stage: string, done?: number, total?: number, what?: Told, left?: number | null}} Now */
/** @typedef {{step: number, iterations: number, gaussians: number, left: number, psnr?: number}} Steps */

/**
 * @typedef {object} Result
 * @property {number} gaussians
 * @property {number} bytes
 * @property {number | null} psnr
 * @property {boolean} aligned whether the PSNR is colour-aligned
 * @property {number | null} seconds
 * @property {Record<string, string>} reports addresses in the output folder, by kind
 */

/** @typedef {{grade: "good" | "usable" | "poor", head: Told, why: Told[], advice: Told[]}} Verdict */
/** @typedef {{name: string, title: string, status: string, grade: string | null, created: string, picture: boolean}} Summary */
/** @typedef {{grade: string, text: Told, advice: Told}} Few */
/** @typedef {{path: string, size: number, modified: number, received: number}} Arrived */
/** @typedef {{name: string, placed: boolean}} Photo */
/** @typedef {{path: string, parent: string, folders: string[], files: string[], photos: number}} Listing */
/** @typedef {{folder?: string, look?: string, addresses: {url: string, code: string}[]}} About */

/**
 * What the photos are, whether they are few, and seconds by quality; or the finished scene that was given.
 * @typedef {{facts: Record<string, Fact>, few: Few | null, seconds: Record<string, number>, scene?: string}} Survey
 */
/** @typedef {Told | number | boolean | Record<string, Told | number>} Fact */

/** A text of the program, in both languages or in English. @typedef {string | {en: string, zh: string}} Told */

export {};
