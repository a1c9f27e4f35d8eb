// Spark, a renderer for three.js.
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { threeCamera, threeRenderer } from "./three_view.js";

export async function show(view) {
    const renderer = threeRenderer(view);
    const camera = threeCamera(view);
    const scene = new THREE.Scene();
    const { mesh, ...options } = view.options;
    scene.add(new SparkRenderer({ renderer, ...options }));
    const splats = new SplatMesh({ url: view.url, ...mesh });
    scene.add(splats);
    await splats.initialized;
    renderer.setAnimationLoop(() => renderer.render(scene, camera));
}
