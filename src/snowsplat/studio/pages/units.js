// Lengths of the scene with their unit.

import { say } from "./text.js";

/**
 * A length of the page, as it will be in the saved scene: metres if a unit is known in metres.
 * @param {{edits: import("./edits.js").Edits, scene: any}} editing
 * @param {number} length in units of the page
 * @param {number} [digits]
 */
export function lengthOf({ edits, scene }, length, digits = 3) {
    const { scale } = edits.present;
    const found = (scale * length) / scene.scale;
    // "Set scale" makes a unit of the saved scene a metre.
    const metres = scale === 1 ? scene.metres : 1;
    return metres ? `${(metres * found).toPrecision(digits)} m` : say("edit_units", found.toPrecision(digits));
}
