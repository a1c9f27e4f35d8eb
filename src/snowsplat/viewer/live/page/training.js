// The part of the panel about the training: its state, its buttons, its curves.
import { Plot } from "./curves.js";
import { byId, showLines, showValue } from "./elements.js";
import { inLanguage, number, text } from "./texts.js";

/**
 * @typedef {object} Training the message of the server
 * @property {boolean} paused whether it pauses after the present step
 * @property {number} share of the time for images
 * @property {number} [step]
 * @property {number} [steps]
 * @property {number | null} [rate] steps per second; null while it is paused
 * @property {number} [gaussians]
 * @property {number | null} [loss]
 * @property {number | null} [psnr]
 * @property {Record<string, string>[]} [finished] lines about the result, in each language
 */

export class TrainingPanel {
    /** @param {(message: object) => void} send */
    constructor(send) {
        this.send = send;
        this.loss = new Plot(byId("loss"));
        this.psnr = new Plot(byId("psnr"));
        /** @type {Training | undefined} */
        this.told = undefined;
        byId("pause").onclick = () => this.togglePause();
        byId("step").onclick = () => send({ type: "training", do: "step" });
        byId("share").oninput = () => {
            showValue(byId("share"));
            send({ type: "share", share: byId("share").value / 100 });
        };
    }

    togglePause() {
        if (this.told && !this.told.finished)
            this.send({ type: "training", do: this.told.paused ? "resume" : "pause" });
    }

    /** @param {{loss: [number[], number[]], psnr: [number[], number[]]}} curves */
    showCurves({ loss, psnr }) {
        this.loss.show(text("loss"), loss);
        this.psnr.show(text("psnr"), psnr);
    }

    /** @param {Training} [told] the newest message */
    show(told = this.told) {
        if (!told) return;
        this.told = told;
        byId("training").hidden = false;
        byId("pause").textContent = text(told.paused ? "resume" : "pause");
        byId("buttons").hidden = byId("viewing").hidden = Boolean(told.finished);
        byId("progress").value = told.finished ? 1 : (told.step ?? 0) / (told.steps ?? 1);
        if (document.activeElement !== byId("share")) byId("share").value = Math.round(100 * told.share);
        showValue(byId("share"));
        showLines(byId("status"), told.finished?.map(inLanguage) ?? this.lines(told));
        this.loss.show(text("loss"));
        this.psnr.show(text("psnr"));
    }

    /** @param {Training} told */
    lines({ step, steps, rate, gaussians, loss, psnr }) {
        if (step === undefined || steps === undefined || gaussians === undefined) return [text("waiting")];
        const pace = rate == null ? text("paused") : text("stepsPerSecond", { rate: number(rate, 1) });
        const figures = {
            gaussians: number(gaussians),
            loss: loss == null ? "–" : number(loss, 4),
            psnr: number(psnr ?? 0, 2),
        };
        return [
            text("stepOf", { step: number(step), steps: number(steps), pace }),
            text(psnr == null ? "figures" : "figuresPsnr", figures),
        ];
    }
}
