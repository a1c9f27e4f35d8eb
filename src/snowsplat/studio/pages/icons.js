// The icons of the tools: lines in a square of 24 units, in the colour of the text.

const SVG = "http://www.w3.org/2000/svg";

/** @type {Record<string, string>} the "d" of a path */
const PATHS = {
    rectangle: "M4 6h3M10 6h4M17 6h3v3M20 12v2M20 17v2h-3M14 19h-4M7 19H4v-2M4 14v-2M4 9V6",
    lasso: "M12 4c-5 0-8 2.5-8 5.5S7 15 12 15s8-2.5 8-5.5S17 4 12 4M7 14c-2 1-2 4 0 4s2 2 1 3",
    brush: "M20 4 10 14M9 13l2 2c1 3-2 5-7 5 2-1 1-3 2-5 .5-1.5 2-2.5 3-2",
    box: "M4 8l8-4 8 4v8l-8 4-8-4zM4 8l8 4 8-4M12 12v8",
    measure: "M3 16 16 3l5 5L8 21zM7 12l2 2M10 9l3 3M13 6l2 2",
    note: "M12 21s-6-6-6-11a6 6 0 0 1 12 0c0 5-6 11-6 11M12 8v4M10 10h4",
    level: "M3 18h18M12 14V4M9 7l3-3 3 3M5 14a7 7 0 0 1 3-5M19 14a7 7 0 0 0-3-5",
    delete: "M5 7h14M9 7V4h6v3M7 7l1 13h8l1-13M10 11v5M14 11v5",
    undo: "M8 5 4 9l4 4M4 9h10a5 5 0 0 1 0 10h-4",
    redo: "M16 5l4 4-4 4M20 9H10a5 5 0 0 0 0 10h4",
};

/** The icon of a tool. */
export function icon(/** @type {string} */ name) {
    const svg = document.createElementNS(SVG, "svg");
    svg.setAttribute("viewBox", "0 0 24 24");
    svg.setAttribute("aria-hidden", "true");
    const path = document.createElementNS(SVG, "path");
    path.setAttribute("d", PATHS[name]);
    svg.append(path);
    return svg;
}
