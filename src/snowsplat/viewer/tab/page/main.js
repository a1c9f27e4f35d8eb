// The page: it reads its data, trains, and shows the scene from a camera that moves freely.
import { Camera } from "../../live/page/camera.js";
import { Plot } from "../../live/page/curves.js";
import { byId, showLines } from "../../live/page/elements.js";
import { listen } from "../../live/page/input.js";
import { dot } from "../../live/page/vectors.js";
import { Gpu } from "./gpu.js";
import { ply } from "./ply.js";
import { OPERATIONS, Trainer } from "./trainer.js";
import { say, switchLanguage, translate } from "./words.js";

const [COARSEST, LONGEST] = [128, 960]; // pixels: the longer side of the image while it trains
const BUSY = 60; // milliseconds of training between two images
const [FAST, SLOW] = [15, 80]; // milliseconds: images that take less become larger, others smaller
const PSNR_EVERY = 100; // steps

const data = JSON.parse(byId("data").textContent);

/** @param {string} text in base64 */
const bytesOf = text => Uint8Array.from(atob(text), character => character.charCodeAt(0));

/** The planar bytes of a JPEG. @param {string} text in base64 @param {number} width @param {number} height */
const pixelsOf = async (text, width, height) => {
    const options = /** @type {ImageBitmapOptions} */ ({ colorSpaceConversion: "none" });
    const picture = await createImageBitmap(new Blob([bytesOf(text)], { type: "image/jpeg" }), options);
    const canvas = new OffscreenCanvas(width, height);
    const context = /** @type {OffscreenCanvasRenderingContext2D} */ (canvas.getContext("2d"));
    context.drawImage(picture, 0, 0);
    const mixed = context.getImageData(0, 0, width, height).data;
    const size = width * height;
    const planar = new Uint8Array(Math.ceil((3 * size) / 4) * 4);
    for (let i = 0; i < size; i++) for (let c = 0; c < 3; c++) planar[c * size + i] = mixed[4 * i + c];
    return planar;
};

/** The first Gaussians: equal in all directions, and transparent. */
const firstGaussians = () => {
    const numbers = (/** @type {string} */ name) => new Float32Array(bytesOf(data.gaussians[name]).buffer);
    const [means, sizes, colors] = ["means", "sizes", "colors"].map(numbers);
    const count = sizes.length;
    return {
        means,
        log_scales: Float32Array.from({ length: 3 * count }, (_, k) => sizes[Math.floor(k / 3)]),
        quats: Float32Array.from({ length: 4 * count }, (_, k) => (k % 4 ? 0 : 1)),
        opacity_logits: new Float32Array(count).fill(data.logit),
        sh_dc: colors,
        sh_rest: new Float32Array(45 * count),
    };
};

class Page {
    /** @param {Trainer} trainer */
    constructor(trainer) {
        this.trainer = trainer;
        this.camera = new Camera(data.scene);
        this.paused = false;
        this.moved = true;
        this.failed = false;
        this.full = false; // the memory does not suffice
        this.photo = 0;
        this.longest = 2 * COARSEST;
        /** Steps between two images. */
        this.pace = 1;
        this.psnr = Number.NaN;
        /** @type {[number[], number[]]} */
        this.losses = [[], []];
        /** @type {[number[], number[]]} */
        this.psnrs = [[], []];
        this.plots = { loss: new Plot(byId("losses")), psnr: new Plot(byId("psnrs")) };
        this.context = byId("image").getContext("2d");
        new ResizeObserver(() => this.look()).observe(byId("stage"));
    }

    look() {
        this.moved = true;
    }

    /** The view of the camera in the window. */
    view() {
        const { clientWidth, clientHeight } = byId("stage");
        const longest = this.paused || this.trainer.done ? LONGEST : this.longest;
        const scale = Math.min(1, longest / Math.max(clientWidth, clientHeight, 1));
        const size = {
            width: Math.max(16, Math.round(scale * clientWidth)),
            height: Math.max(16, Math.round(scale * clientHeight)),
        };
        const { right, down, ahead } = this.camera.axes();
        const [across, below] = this.camera.shown(size);
        const pose = [right, down, ahead].flatMap(axis => [...axis, -dot(axis, this.camera.position)]);
        const focal = { fx: size.width / 2 / across, fy: size.height / 2 / below };
        return { ...size, ...focal, cx: size.width / 2, cy: size.height / 2, near: data.near, pose };
    }

    async show() {
        this.moved = false;
        const begin = performance.now();
        const view = this.view();
        const picture = await this.trainer.renderer.picture(this.trainer.gaussians, view);
        const canvas = byId("image");
        if (canvas.width !== view.width || canvas.height !== view.height)
            Object.assign(canvas, { width: view.width, height: view.height });
        const took = performance.now() - begin;
        const factor = took < FAST ? 1.25 : took > SLOW ? 0.7 : 1;
        this.longest = Math.max(COARSEST, Math.min(LONGEST, factor * this.longest));
        this.context.putImageData(new ImageData(picture, view.width, view.height), 0, 0);
    }

    async advance() {
        const { trainer } = this;
        const begin = performance.now();
        const steps = Math.min(this.pace, trainer.ahead);
        await trainer.train(steps);
        const each = (performance.now() - begin) / steps;
        this.pace = Math.max(1, Math.min(2 * this.pace, Math.round(BUSY / each)));
        this.losses[0].push(trainer.step);
        this.losses[1].push(trainer.loss);
        if (trainer.step % PSNR_EVERY === 0 || trainer.done) {
            this.psnr = await trainer.psnr();
            this.psnrs[0].push(trainer.step);
            this.psnrs[1].push(this.psnr);
        }
        this.moved = true;
    }

    tell() {
        const { trainer, psnr } = this;
        const { step, steps, count, loss } = trainer;
        const whole = (/** @type {number} */ value) => value.toLocaleString("en");
        const lines = [say("stepOf", { step: whole(step), steps: whole(steps) })];
        if (step) lines.push(say("figures", { gaussians: whole(count), loss: loss.toFixed(4) }));
        if (Number.isFinite(psnr))
            lines.push(say(trainer.heldOut.length ? "heldOut" : "used", { psnr: psnr.toFixed(2) }));
        showLines(byId("status"), lines);
        byId("progress").value = step / steps;
        byId("pause").textContent = say(this.paused ? "resume" : "pause");
        byId("pause").disabled = trainer.done;
        this.plots.loss.show(say("loss"), this.losses);
        this.plots.psnr.show(say("psnr"), this.psnrs);
    }

    /** Train and draw, until the page is closed. */
    async run() {
        this.tell();
        byId("notice").textContent = say("first");
        await this.show();
        byId("notice").textContent = "";
        for (;;) {
            await new Promise(requestAnimationFrame);
            if (!this.full) {
                if (!this.paused && !this.trainer.done) await this.advance();
                if (this.moved) await this.show();
                this.tell();
            }
            await this.asked?.();
        }
    }

    /** The scene as a PLY file: between two steps. @returns {Promise<Uint8Array<ArrayBuffer>>} */
    file() {
        return new Promise(resolve => {
            this.asked = async () => {
                this.asked = undefined;
                const { count, values } = await this.trainer.state();
                resolve(ply(count, values));
            };
        });
    }

    goToNext() {
        this.photo = (this.photo + 1) % data.scene.photos.length;
        this.camera.goTo(this.photo);
        this.look();
    }

    pause() {
        this.paused = !this.paused;
        this.look();
    }

    async download() {
        byId("download").disabled = true;
        const url = URL.createObjectURL(new Blob([await this.file()]));
        Object.assign(document.createElement("a"), { href: url, download: `${data.file}.ply` }).click();
        setTimeout(() => URL.revokeObjectURL(url), 60_000);
        byId("download").disabled = false;
    }
}

const start = async () => {
    translate();
    byId("language").onclick = switchLanguage;
    const gpu = await Gpu.open(data.shaders, data.plan);
    if (!gpu) {
        byId("notice").textContent = say("noWebgpu");
        return;
    }
    /** @type {import('./trainer.js').Photo[]} */
    const photos = [];
    for (const view of data.views) {
        byId("notice").textContent = say("reading", { number: photos.length + 1, photos: data.views.length });
        photos.push({ ...view, pixels: await pixelsOf(view.jpeg, view.width, view.height) });
        view.jpeg = "";
    }
    await gpu.prepare(OPERATIONS, (number, kernels) => {
        byId("notice").textContent = say("preparing", { number, kernels });
    });
    const page = new Page(new Trainer(gpu, firstGaussians(), photos, data.scene.extent, data.recipe));
    Object.assign(window, { snowsplat: page }); // for the console of the browser
    listen(byId("stage"), {
        camera: () => page.camera,
        moved: () => page.look(),
        clicked: () => {},
        hovered: () => {},
        keys: { n: () => page.goToNext(), " ": () => page.pause(), r: () => page.camera.reset() },
    });
    for (const button of ["pause", "next", "download"]) byId(button).disabled = false;
    byId("pause").onclick = () => page.pause();
    byId("next").onclick = () => page.goToNext();
    byId("download").onclick = () => page.download();
    /** @param {unknown} error */
    const stop = error => {
        if (page.failed) return; // other errors follow from the first one
        page.failed = page.paused = true;
        page.full = error instanceof RangeError;
        byId("notice").textContent = page.full ? say("memory") : say("failed", { reason: String(error) });
        if (page.full) page.run().catch(stop); // the download still works
    };
    gpu.device.lost.then((/** @type {any} */ info) => stop(info.message));
    gpu.device.onuncapturederror = (/** @type {any} */ event) => stop(event.error.message);
    await page.run().catch(stop);
};

start();
