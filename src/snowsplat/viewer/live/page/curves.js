// The curve of a value over the steps of a training.

const SVG = "http://www.w3.org/2000/svg";
const [WIDTH, HEIGHT] = [240, 72];

/** @param {number} value */
const short = value => value.toLocaleString("en", { maximumSignificantDigits: 4, useGrouping: false });

export class Plot {
    /** @param {HTMLElement} figure in which it is drawn */
    constructor(figure) {
        this.figure = figure;
        this.caption = document.createElement("figcaption");
        this.svg = document.createElementNS(SVG, "svg");
        this.svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
        this.svg.setAttribute("preserveAspectRatio", "none");
        this.svg.setAttribute("role", "img");
        this.line = document.createElementNS(SVG, "polyline");
        this.cursor = document.createElementNS(SVG, "line");
        this.cursor.setAttribute("y2", String(HEIGHT));
        this.svg.append(this.cursor, this.line);
        this.ends = document.createElement("div");
        this.ends.append(...["span", "span"].map(tag => document.createElement(tag)));
        figure.append(this.caption, this.svg, this.ends);
        this.svg.onpointermove = ({ offsetX }) => this.describe(offsetX / this.svg.clientWidth);
        this.svg.onpointerleave = () => this.describe(1);
        this.name = "";
        /** @type {[number[], number[]]} */
        this.data = [[], []];
    }

    /** Show steps and values, with the name of the value. @param {string} name @param {[number[], number[]]} [data] */
    show(name, data = this.data) {
        const known = data[0].map((_, i) => i).filter(i => Number.isFinite(data[1][i]));
        this.name = name;
        this.data = [known.map(i => data[0][i]), known.map(i => data[1][i])];
        const [steps, values] = this.data;
        this.figure.hidden = steps.length < 2;
        if (this.figure.hidden) return;
        const [first, last] = [steps[0], steps[steps.length - 1]];
        const [low, high] = [Math.min(...values), Math.max(...values)];
        const at = (/** @type {number} */ i) => {
            const x = ((steps[i] - first) / (last - first || 1)) * WIDTH;
            const y = HEIGHT - 3 - ((values[i] - low) / (high - low || 1)) * (HEIGHT - 6);
            return `${x.toFixed(1)},${y.toFixed(1)}`;
        };
        this.line.setAttribute("points", steps.map((_, i) => at(i)).join(" "));
        const [start, end] = this.ends.children;
        start.textContent = `${short(low)} – ${short(high)}`;
        end.textContent = Math.round(last).toLocaleString("en");
        this.describe(1);
    }

    /** The value at a share of the width. @param {number} share */
    describe(share) {
        const [steps, values] = this.data;
        const step = steps[0] + share * (steps[steps.length - 1] - steps[0]);
        let i = steps.findIndex(each => each >= step - 1e-9);
        if (i < 0) i = steps.length - 1;
        const where = share < 1 ? ` · ${Math.round(steps[i]).toLocaleString("en")}` : "";
        this.caption.textContent = `${this.name} ${short(values[i])}${where}`;
        this.svg.setAttribute("aria-label", this.caption.textContent);
        const x = String(share < 1 ? share * WIDTH : -9);
        this.cursor.setAttribute("x1", x);
        this.cursor.setAttribute("x2", x);
    }
}
