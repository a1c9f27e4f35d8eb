// Babylon.js.
import { TargetCamera } from "@babylonjs/core/Cameras/targetCamera.js";
import { Engine } from "@babylonjs/core/Engines/engine.js";
import { Color4 } from "@babylonjs/core/Maths/math.color.js";
import { Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import { GaussianSplattingMesh } from "@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js";
import { Scene } from "@babylonjs/core/scene.js";

export async function show({ url, width, height, focal, worldFromCamera, options }) {
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    document.body.append(canvas);
    const engine = new Engine(canvas, false, { preserveDrawingBuffer: true });
    const scene = new Scene(engine);
    scene.useRightHandedSystem = true;
    scene.clearColor = new Color4(0, 0, 0, 1);
    const column = i => Vector3.FromArray(worldFromCamera, 4 * i);
    const camera = new TargetCamera("camera", column(3), scene);
    camera.upVector = column(1);
    camera.setTarget(column(3).subtract(column(2)));
    camera.fov = 2 * Math.atan(height / (2 * focal));
    camera.minZ = 0.01;
    camera.maxZ = 1000;
    const splats = new GaussianSplattingMesh("scene", null, scene);
    const file = await (await fetch(url)).arrayBuffer();
    if (url.endsWith(".splat")) {
        await splats.updateDataAsync(file);
    } else {
        const { buffer, sh } = await GaussianSplattingMesh.ConvertPLYWithSHToSplatAsync(file);
        await splats.updateDataAsync(buffer, sh);
    }
    Object.assign(splats.material, options);
    engine.runRenderLoop(() => scene.render());
}
