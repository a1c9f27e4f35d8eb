// GaussianSplats3D, a viewer that uses three.js.
import * as GaussianSplats3D from "@mkkellogg/gaussian-splats-3d";
import { threeCamera, threeRenderer } from "./three_view.js";

export async function show(view) {
    const { scene, ...options } = view.options;
    const renderer = threeRenderer(view);
    const viewer = new GaussianSplats3D.Viewer({
        renderer,
        camera: threeCamera(view),
        rootElement: renderer.domElement, // of which it takes the size
        selfDrivenMode: false,
        useBuiltInControls: false,
        sharedMemoryForWorkers: false, // needs headers of the server
        sceneRevealMode: GaussianSplats3D.SceneRevealMode.Instant,
        ...options,
    });
    await viewer.addSplatScene(view.url, { showLoadingUI: false, ...scene });
    const draw = () => {
        viewer.update();
        viewer.render();
        requestAnimationFrame(draw);
    };
    draw();
}
