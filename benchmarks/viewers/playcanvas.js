// The engine of PlayCanvas, which also draws the scenes of SuperSplat.
import * as pc from "playcanvas";

export async function show({ url, width, height, focal, worldFromCamera, options }) {
    const canvas = document.createElement("canvas");
    document.body.append(canvas);
    const app = new pc.Application(canvas, {
        graphicsDeviceOptions: { antialias: false, alpha: false },
    });
    app.setCanvasFillMode(pc.FILLMODE_NONE, width, height);
    app.setCanvasResolution(pc.RESOLUTION_FIXED, width, height);
    const { lowPass, ...settings } = options;
    Object.assign(app.scene.gsplat, settings);
    if (lowPass) changeShaders(app.graphicsDevice, lowPass);
    app.start();
    const camera = new pc.Entity();
    camera.addComponent("camera", {
        clearColor: new pc.Color(0, 0, 0, 1),
        fov: (360 / Math.PI) * Math.atan(height / (2 * focal)),
        nearClip: 0.01,
        farClip: 1000,
    });
    const pose = new pc.Mat4().set(worldFromCamera);
    camera.setLocalPosition(pose.getTranslation());
    camera.setLocalRotation(new pc.Quat().setFromMat4(pose));
    app.root.addChild(camera);
    const asset = new pc.Asset("scene", "gsplat", { url });
    await new Promise((resolve, reject) => {
        asset.on("load", resolve);
        asset.on("error", message => reject(new Error(message)));
        app.assets.add(asset);
        app.assets.load(asset);
    });
    const splats = new pc.Entity();
    splats.addComponent("gsplat", { asset });
    app.root.addChild(splats);
}

// Two numbers have no setting: they are replaced in the chunks of its shaders. The second one is that
// its Gaussians are 0 at their borders, which makes all of them a little smaller.
function changeShaders(device, lowPass) {
    const chunks = pc.ShaderChunks.get(device, pc.SHADERLANGUAGE_GLSL);
    const change = (name, from, to) => chunks.set(name, chunks.get(name).replaceAll(from, to));
    change("gsplatCornerVS", "+ 0.3", `+ ${lowPass}`);
    change("gsplatPS", "(exp(x * -4.0) - EXP4) * INV_EXP4", "exp(x * -4.0)");
}
