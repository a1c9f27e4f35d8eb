// The image of Gaussians from a view, as in `ops/rasterizer.py`.

/** @typedef {import('./gpu.js').Gpu} Gpu */
/** @typedef {import('./gpu.js').Buffer} Buffer */
/** @typedef {import('./gpu.js').Values} Values */
/**
 * A pinhole camera: pixels, and `pose` is (3, 4) cam_from_world.
 * @typedef {{width: number, height: number, fx: number, fy: number, cx: number, cy: number, near: number,
 *     pose: ArrayLike<number>}} View
 */
/** @typedef {{count: number, degree: number, buffers: Record<string, Buffer>}} Gaussians */

/** The parameters of a Gaussian, and how many numbers each of them has. */
export const PARAMETERS = { means: 3, log_scales: 3, quats: 4, opacity_logits: 1, sh_dc: 3, sh_rest: 45 };
export const STRIDE = 16; // columns of a splat
const TILE = 16;
const SH_REST_ROWS = 15;
const COLORS = new Int32Array([8, 0, 9, 0, 10, 0, -1, -1]); // columns of a splat, 64 bits each

export class Renderer {
    /** @param {Gpu} gpu */
    constructor(gpu) {
        this.gpu = gpu;
        this.columns = gpu.upload(COLORS);
        this.background = gpu.make(12); // black
        /** Instances (pairs of a splat and a tile) that memory is allocated for. */
        this.capacity = 1 << 12;
    }

    /**
     * Whether an image needed more memory than it had; then the next one has more.
     * @param {number} required instances @param {number} had
     * @throws {RangeError} the browser does not give as much
     */
    outgrew(required, had = this.capacity) {
        const most = Math.floor(this.gpu.largest / 64); // bytes of the gradient of an instance
        if (required > most) throw new RangeError("memory");
        if (required > this.capacity) this.capacity = Math.min(Math.ceil(1.5 * required), most);
        return required > had;
    }

    /** The fields of an operation that reads the Gaussians. @param {Gaussians} gaussians @param {View} view @returns {Values} */
    fields({ count, degree, buffers }, view) {
        const camera = this.gpu.temporary("camera", 48);
        this.gpu.device.queue.writeBuffer(camera, 0, new Float32Array(view.pose));
        const { width, height, fx, fy, cx, cy, near } = view;
        return {
            n: count,
            ...Object.fromEntries(Object.entries(buffers).map(([name, buffer]) => [`gaussians_${name}`, buffer])),
            gaussians_sh_rest_rows: SH_REST_ROWS,
            gaussians_sh_degree: degree,
            gaussians_sh_dc_rows: 1,
            camera_cam_from_world: camera,
            ...{ camera_width: width, camera_height: height, camera_fx: fx, camera_fy: fy },
            ...{ camera_cx: cx, camera_cy: cy, camera_near: near, camera_antialiased: 0 },
        };
    }

    /**
     * Queue the image, (3, height, width). No other queued command may depend on another view: call
     * `submit` before. Returns the fields of the operations that follow.
     * @param {Gaussians} gaussians @param {View} view @returns {Values}
     */
    draw(gaussians, view) {
        const { gpu, capacity, columns } = this;
        const n = gaussians.count;
        const { width, height } = view;
        const [tilesX, tilesY] = [Math.ceil(width / TILE), Math.ceil(height / TILE)];
        const words = (/** @type {string} */ name, /** @type {number} */ size) => gpu.temporary(name, 4 * size);
        const packed = words("packed", STRIDE * n);
        const order = words("order", n);
        const instances = {
            capacity,
            required: words("required", 2),
            instance_splat: words("instance_splat", capacity),
            instance_slot: words("instance_slot", capacity),
            slot_range: words("slot_range", 2 * n),
        };
        const binning = {
            binning_order: order,
            binning_packed: packed,
            binning_stride: STRIDE,
            binning_tiles_x: tilesX,
            binning_tiles_y: tilesY,
            binning_workspace: words("workspace", 4 + 2 * n),
            binning_tile_start: words("tile_start", tilesX * tilesY + 1),
        };
        const sort = { keys: words("keys", n), keys2: words("keys2", n), order, order2: words("order2", n) };
        const frame = {
            frame_width: width,
            frame_height: height,
            frame_packed: packed,
            frame_stride: STRIDE,
            frame_columns: columns,
            frame_tile_start: binning.binning_tile_start,
            frame_instance_splat: instances.instance_splat,
            frame_additive: 0,
            channels: 3,
        };
        const image = words("image", 3 * width * height);
        const projected = { ...this.fields(gaussians, view), ids: words("ids", n), packed };
        gpu.follow("project_cull", projected);
        gpu.follow("project_fwd", projected);
        gpu.follow("splats_prepare", { n, packed, stride: STRIDE, width, height, columns, ...sort });
        gpu.follow("splats_sort", { n, ...sort });
        gpu.follow("tiles_count", { n, ...binning, ...instances });
        gpu.follow("tiles_fill", { n, ...binning, ...instances });
        gpu.follow("rasterize_fwd", { n: tilesX * tilesY, ...frame, background: this.background, image });
        return { ...projected, ...instances, ...frame, image, width, height, tiles: tilesX * tilesY };
    }

    /** An image as RGBA bytes, (height, width); drawn again if the memory did not suffice. @param {Gaussians} gaussians @param {View} view */
    async picture(gaussians, view) {
        const { gpu } = this;
        const { width, height } = view;
        for (;;) {
            gpu.submit();
            const { image, required, capacity } = this.draw(gaussians, view);
            const pixels = gpu.temporary("pixels", 4 * width * height);
            gpu.run("show", "show", Math.ceil((width * height) / 64), { image, pixels, width, height });
            const [bytes, needed] = await gpu.read([
                [pixels, 4 * width * height],
                [required, 8],
            ]);
            if (!this.outgrew(new Uint32Array(needed)[0], capacity)) return new Uint8ClampedArray(bytes);
        }
    }
}
