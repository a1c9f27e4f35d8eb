// How the scene is turned while it is edited. It turns about its middle, as the sliders of the page
// measure from there. Points that are kept are those of the world before the scene is turned.

import { inverse, product, turned } from "./turning.js";

/**
 * @param {any} page see panel.js
 * @param {import("./edits.js").Edits} edits with the annotations of the viewer
 */
export function addPlacement({ viewer: { app, annotations }, scene }, edits) {
    const entity = app.root.findByName("gsplat");
    const markers = app.root.findByName("annotations"); // of the viewer; null if there are none
    const views = edits.present.notes.map(note => note.view);
    const middle = scene.subject.slice(0, 3);
    return {
        placed: (/** @type {number[]} */ point) => turned(edits.present.turn, point, middle),
        unplaced: (/** @type {number[]} */ point) => turned(inverse(edits.present.turn), point, middle),
        isTurned: () => Math.abs(edits.present.turn[0]) < 1 - 1e-12,
        /** Shows the scene, and the annotations of the viewer, as they are turned, and further. */
        show(/** @type {number[]} */ further) {
            const turn = product(further, edits.present.turn);
            const [w, x, y, z] = product(turn, [0, 0, 0, 1]); // the viewer has turned it by 180°
            const origin = turned(turn, [0, 0, 0], middle);
            entity.setLocalRotation(x, y, z, w);
            entity.setLocalPosition(...origin);
            markers?.setLocalRotation(turn[1], turn[2], turn[3], turn[0]);
            markers?.setLocalPosition(...origin);
            views.forEach((view, i) => {
                const [position, target] = [view.slice(0, 3), view.slice(3, 6)].map(point =>
                    turned(turn, point, middle),
                );
                Object.assign(annotations[i], { position: target });
                Object.assign(annotations[i].camera.initial, { position, target });
            });
            app.renderNextFrame = true;
        },
    };
}
