// How the viewer draws what is selected and what is deleted.

import { DELETED, SELECTED } from "./edits.js";

// The engine copies the Gaussians into a buffer before it draws them; this code changes the copies.
const STREAM = "snowState";
const R8U = 33; // PIXELFORMAT_R8U of the engine: a byte per Gaussian
const OF_INSTANCE = 1; // GSPLAT_STREAM_INSTANCE

/** The code of the sliders of the page under other names, and ours, which calls it. */
function shader(/** @type {{glsl: string, wgsl: string}} */ sliders) {
    const renamed = (/** @type {string} */ code) => code.replaceAll("modifySplat", "hideSplat");
    return {
        glsl: `${renamed(sliders.glsl)}
void modifySplatCenter(inout vec3 center) {}
void modifySplatRotationScale(vec3 center, vec3 modified, inout vec4 rotation, inout vec3 scale) {
    hideSplatRotationScale(center, modified, rotation, scale);
    if (loadSnowState().r == ${DELETED}u) scale = vec3(0.0);
}
void modifySplatColor(vec3 center, inout vec4 color) {
    if (loadSnowState().r == ${SELECTED}u) color.xyz = mix(color.xyz, vec3(1.0, 0.4, 0.0), 0.65);
}`,
        wgsl: `${renamed(sliders.wgsl)}
fn modifySplatCenter(center: ptr<function, vec3f>) {}
fn modifySplatRotationScale(center: vec3f, modified: vec3f, rotation: ptr<function, vec4f>, scale: ptr<function, vec3f>) {
    hideSplatRotationScale(center, modified, rotation, scale);
    if (loadSnowState().r == ${DELETED}u) { *scale = vec3f(0.0); }
}
fn modifySplatColor(center: vec3f, color: ptr<function, vec4f>) {
    if (loadSnowState().r == ${SELECTED}u) { *color = vec4f(mix((*color).xyz, vec3f(1.0, 0.4, 0.0), 0.65), (*color).w); }
}`,
    };
}

/**
 * Returns what shows a byte per Gaussian: 0, SELECTED or DELETED.
 * @param {any} app of the viewer
 * @param {any} hiding the sliders of the page; see hiding.js
 */
export function painter(app, hiding) {
    const { gsplat } = app.root.findByName("gsplat");
    const { resource } = app.assets.get(gsplat.asset);
    return (/** @type {Uint8Array} */ state) => {
        resource.format.addExtraStreams([{ name: STREAM, format: R8U, storage: OF_INSTANCE }]);
        const texture = gsplat.getInstanceTexture(STREAM);
        const bytes = texture.lock();
        bytes.fill(0);
        bytes.set(state);
        texture.unlock();
        hiding.use(shader(hiding.code)); // also copies the Gaussians again
    };
}
