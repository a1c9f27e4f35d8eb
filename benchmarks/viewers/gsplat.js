// gsplat.js: scenes without view-dependent colour.
import * as SPLAT from "gsplat";

export async function show({ url, width, height, focal, worldFromCamera, options }) {
    if (options.lowPass) setLowPass(options.lowPass);
    const canvas = document.createElement("canvas");
    document.body.append(canvas);
    const renderer = new SPLAT.WebGLRenderer(canvas, []);
    renderer.setSize(width, height);
    const scene = new SPLAT.Scene();
    const loader = url.endsWith(".ply") ? SPLAT.PLYLoader : SPLAT.Loader;
    await loader.LoadAsync(url, scene, () => {});
    const camera = new SPLAT.Camera();
    camera.data.fx = camera.data.fy = focal;
    // Its cameras look along +z, with y down.
    const m = worldFromCamera;
    const rotation = new SPLAT.Matrix3(m[0], -m[4], -m[8], m[1], -m[5], -m[9], m[2], -m[6], -m[10]);
    camera.rotation = SPLAT.Quaternion.FromMatrix3(rotation);
    camera.position = new SPLAT.Vector3(m[12], m[13], m[14]);
    const draw = () => {
        renderer.render(scene, camera);
        requestAnimationFrame(draw);
    };
    draw();
}

// It has no such setting: the number is replaced in the source of its shader.
function setLowPass(value) {
    const program = SPLAT.RenderProgram.prototype;
    const source = program._getVertexSource;
    program._getVertexSource = () => source().replaceAll("+= 0.3", `+= ${value}`);
}
