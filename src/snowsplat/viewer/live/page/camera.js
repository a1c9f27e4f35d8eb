// The camera: it looks at a point, in orbit about it, and keeps its up direction.
import { add, axesOf, cross, dot, norm, quatOf, scaled, subtract, turned, unit } from "./vectors.js";

/** @typedef {import('./vectors.js').Vec} Vec */
/** @typedef {import('./vectors.js').Quat} Quat */
/**
 * A photo: `half` are the tangents of half of its fields of view, across and down.
 * @typedef {{name: string, heldOut: boolean, half: [number, number], quat: Quat, position: Vec}} Photo
 */
/** @typedef {{up: Vec, focus: Vec, bounds: [Vec, Vec], extent: number, photos: Photo[]}} Scene */
/** @typedef {{width: number, height: number}} Size in pixels */

const STEEPEST = 0.02; // radians: the smallest angle between the directions of view and of up
const MARGIN = 1.1; // a framed scene fills the window, except for this factor

export class Camera {
    /** @param {Scene} scene */
    constructor(scene) {
        this.centre = scaled(add(...scene.bounds), 0.5);
        this.radius = norm(subtract(scene.bounds[1], scene.bounds[0])) / 2 || scene.extent || 1;
        this.extent = scene.extent || this.radius;
        this.scene = scene;
        /** @type {number | null} the photo from whose position it looks */
        this.photo = null;
        /** @type {Vec} */
        this.position = this.target = this.centre;
        /** @type {Vec} */
        this.up = scene.up;
        /** Of the photo that is inside the window. @type {[number, number]} */
        this.half = [1, 1];
        this.reset();
    }

    /** The first view: that of the first photo, with the up direction of the scene. */
    reset() {
        this.goTo(0);
        this.photo = null;
        const ahead = unit(subtract(this.target, this.position));
        if (norm(cross(ahead, this.scene.up)) > STEEPEST) this.up = unit(this.scene.up);
    }

    /** To the position of a photo. @param {number} index */
    goTo(index) {
        const { position, quat, half } = this.scene.photos[index];
        const { down, ahead } = axesOf(quat);
        this.photo = index;
        this.position = position;
        this.up = scaled(down, -1);
        // The point on the optical axis that is nearest to what the photos show.
        const distance = dot(ahead, subtract(this.scene.focus, position));
        this.target = add(position, ahead, Math.max(distance, 0.1 * this.extent));
        this.half = half;
    }

    /** The whole scene, from the present direction. @param {Size} size */
    frame(size) {
        const { ahead } = this.axes();
        const [across, down] = this.shown(size);
        const distance = (MARGIN * this.radius) / Math.sin(Math.atan(Math.min(across, down)));
        this.photo = null;
        this.target = this.centre;
        this.position = add(this.centre, ahead, -distance);
    }

    get distance() {
        return norm(subtract(this.target, this.position));
    }

    axes() {
        const ahead = unit(subtract(this.target, this.position));
        const right = unit(cross(ahead, this.up));
        return { right, down: cross(ahead, right), ahead };
    }

    /**
     * The tangents of half of the fields of view in a window: all of the photo is inside.
     * @param {Size} size
     */
    shown({ width, height }) {
        const down = Math.max(this.half[1], (this.half[0] * height) / width);
        return [(down * width) / height, down];
    }

    /** Turn about the target. @param {number} across radians @param {number} down radians */
    orbit(across, down) {
        const { right, ahead } = this.axes();
        const steep = Math.acos(Math.max(-1, Math.min(1, dot(ahead, this.up))));
        const limited = Math.max(STEEPEST, Math.min(Math.PI - STEEPEST, steep + down)) - steep;
        const tilted = turned(ahead, right, -limited);
        const direction = turned(tilted, this.up, -across);
        const distance = this.distance;
        this.photo = null;
        this.position = add(this.target, direction, -distance);
    }

    /** Move with the target, in units of the camera's axes. @param {Vec} by */
    move([right, down, ahead]) {
        const axes = this.axes();
        const by = add(add(scaled(axes.right, right), axes.down, down), axes.ahead, ahead);
        this.photo = null;
        this.position = add(this.position, by);
        this.target = add(this.target, by);
    }

    /** Change the distance to the target. Near it, the target moves ahead. @param {number} factor */
    zoom(factor) {
        const { ahead } = this.axes();
        const nearest = 1e-2 * this.extent;
        const distance = Math.min(this.distance * factor, 1e3 * this.extent);
        this.photo = null;
        this.position = add(this.target, ahead, -distance);
        if (distance < nearest) this.target = add(this.position, ahead, nearest);
    }

    /** What the server gets. @param {Size} size @param {number} number of this view */
    view(size, number) {
        const fov = 2 * Math.atan(this.shown(size)[1]);
        return {
            type: "view",
            number,
            quat: quatOf(this.axes()),
            position: this.position,
            fov,
            ...size,
            photo: this.photo,
        };
    }
}
