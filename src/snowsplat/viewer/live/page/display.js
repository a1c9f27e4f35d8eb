// The part of the panel about what is shown: mode, sizes, comparison with a photo, crop box.
import { byId, showValue } from "./elements.js";
import { text } from "./texts.js";

// Where the colours of a mode stand for numbers: the ends of its scale.
const SCALES = /** @type {Record<string, () => [string, string]>} */ ({
    depth: () => [text("far"), text("near")],
    cost: () => ["0", "≥ 256"],
    error: () => ["0", "≥ 25%"],
});

export class DisplayPanel {
    /** @param {() => void} changed is called when the settings have changed */
    constructor(changed) {
        this.changed = changed;
        this.atPhoto = false;
        /** @type {HTMLInputElement[][]} two sliders for each axis */
        this.ranges = [];
        for (const id of ["degree", "size", "longest", "wipe"]) {
            showValue(byId(id));
            byId(id).oninput = () => {
                showValue(byId(id));
                changed();
            };
        }
        byId("mode").onchange = () => {
            this.describe();
            changed();
        };
        byId("cropped").onchange = changed;
        byId("render").onclick = () => this.wipeTo(0);
        byId("photo").onclick = () => this.wipeTo(100);
    }

    /** @param {number} percent */
    wipeTo(percent) {
        byId("wipe").value = String(percent);
        showValue(byId("wipe"));
        this.changed();
    }

    /** The sliders of the crop box, which begins at the bounds of the scene. @param {[number[], number[]]} bounds */
    setBounds([low, high]) {
        if (this.ranges.length) return;
        this.ranges = low.map((from, axis) => {
            const [middle, half] = [(from + high[axis]) / 2, (high[axis] - from) / 2 || 1];
            return [from, high[axis]].map((value, end) => {
                const slider = document.createElement("input");
                const [min, max] = [middle - 2 * half, middle + 2 * half];
                Object.assign(slider, { type: "range", min, max, step: (max - min) / 400, value });
                slider.dataset.end = String(end);
                slider.oninput = () => this.moveEnd(axis, end);
                return slider;
            });
        });
        byId("ranges").replaceChildren(
            ...this.ranges.map(sliders => {
                const row = document.createElement("div");
                row.className = "range";
                row.append(document.createElement("span"), ...sliders);
                return row;
            }),
        );
        this.describe();
    }

    /** The ends of a range do not pass each other. @param {number} axis @param {number} end */
    moveEnd(axis, end) {
        const [moved, other] = [this.ranges[axis][end], this.ranges[axis][1 - end]];
        const limit = end ? Math.max : Math.min;
        moved.value = String(limit(Number(moved.value), Number(other.value)));
        byId("cropped").checked = true;
        this.changed();
    }

    /** @param {boolean} atPhoto whether the camera is at a photo, with which it can be compared */
    setAtPhoto(atPhoto) {
        this.atPhoto = atPhoto;
        byId("compare").hidden = !atPhoto;
        this.describe();
    }

    /** Texts that depend on the settings. */
    describe() {
        const mode = byId("mode").value;
        const missing = mode === "error" && !this.atPhoto;
        byId("legend").textContent = text(missing ? "needsPhoto" : `${mode}Legend`);
        const scale = byId("scale");
        scale.hidden = !(mode in SCALES) || missing;
        scale.dataset.mode = mode;
        if (mode in SCALES) [scale.children[1].textContent, scale.children[2].textContent] = SCALES[mode]();
        this.ranges.forEach((sliders, axis) => {
            const name = text(`axis${axis}`);
            const label = sliders[0].parentElement?.firstElementChild;
            if (label) label.textContent = name;
            sliders.forEach((slider, end) => {
                slider.setAttribute("aria-label", text(end ? "to" : "from", { axis: name }));
            });
        });
    }

    /** What the server gets. */
    message() {
        const [low, high] = [0, 1].map(end => this.ranges.map(sliders => Number(sliders[end].value)));
        return {
            type: "display",
            mode: byId("mode").value,
            degree: Number(byId("degree").value),
            scale: byId("size").value / 100,
            wipe: byId("wipe").value / 100,
            longest: Number(byId("longest").value),
            crop: byId("cropped").checked && this.ranges.length ? [low, high] : null,
        };
    }
}
