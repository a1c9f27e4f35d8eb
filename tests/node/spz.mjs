// The reference implementation of .spz (compiled to WebAssembly) in the frame of the PLY files.
//
// A line on stdin is a JSON object: {path}, or {path, version, scene} to write the scene first. The
// answer is a line on stdout: the scene in the file as JSON.
import { readFileSync, writeFileSync } from "node:fs";
import { createInterface } from "node:readline";
import createModule from "@adobe/spz";

console.log = console.error; // its notes, which would stand between the answers
const spz = await createModule();
const frame = spz.CoordinateSystem.RDF;
const names = ["positions", "scales", "rotations", "alphas", "colors", "sh"];

function write(path, version, scene) {
    const cloud = { ...scene, antialiased: false, extensions: [] };
    for (const name of names) cloud[name] = new Float32Array(scene[name]);
    const options = { version, from: frame, sh1Bits: 5, shRestBits: 4 };
    writeFileSync(path, spz.saveSpzToBuffer(cloud, options));
}

function read(path) {
    const cloud = spz.loadSpzFromBuffer(new Uint8Array(readFileSync(path)), { to: frame });
    const scene = { numPoints: cloud.numPoints, shDegree: cloud.shDegree };
    for (const name of names) scene[name] = Array.from(cloud[name]);
    // Opacities of 0 and 1 have infinite logits there, and JSON has no word for them.
    scene.alphas = scene.alphas.map(alpha => Math.max(-20, Math.min(20, alpha)));
    return scene;
}

for await (const line of createInterface({ input: process.stdin })) {
    const { path, version, scene } = JSON.parse(line);
    if (scene) write(path, version, scene);
    process.stdout.write(`${JSON.stringify(read(path))}\n`);
}
