// The camera and the canvas of the viewers that use three.js.
import * as THREE from "three";

export function threeRenderer({ width, height }) {
    const renderer = new THREE.WebGLRenderer({ antialias: false });
    renderer.setPixelRatio(1);
    renderer.setSize(width, height);
    renderer.setClearColor(0, 1);
    document.body.append(renderer.domElement);
    return renderer;
}

export function threeCamera({ width, height, focal, worldFromCamera }) {
    const angle = (360 / Math.PI) * Math.atan(height / (2 * focal));
    const camera = new THREE.PerspectiveCamera(angle, width / height, 0.01, 1000);
    const pose = new THREE.Matrix4().fromArray(worldFromCamera);
    pose.decompose(camera.position, camera.quaternion, camera.scale);
    camera.updateMatrixWorld();
    return camera;
}
