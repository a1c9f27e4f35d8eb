// The reference implementation of .spz (compiled to WebAssembly) in the frame of the PLY files:
// what it reads from a file as JSON, or a file that it writes from such JSON.
//
//   node spz.mjs read scene.spz > scene.json
//   node spz.mjs write VERSION scene.spz < scene.json
import { readFileSync, writeFileSync } from "node:fs";
import createModule from "@adobe/spz";

console.log = console.error; // its notes, which would stand before the JSON
const spz = await createModule();
const frame = spz.CoordinateSystem.RDF;
const names = ["positions", "scales", "rotations", "alphas", "colors", "sh"];
const [verb, ...rest] = process.argv.slice(2);
if (verb === "read") {
  const cloud = spz.loadSpzFromBuffer(new Uint8Array(readFileSync(rest[0])), { to: frame });
  const scene = { numPoints: cloud.numPoints, shDegree: cloud.shDegree };
  for (const name of names) scene[name] = Array.from(cloud[name]);
  // Opacities of 0 and 1 have infinite logits there, and JSON has no word for them.
  scene.alphas = scene.alphas.map((alpha) => Math.max(-20, Math.min(20, alpha)));
  process.stdout.write(JSON.stringify(scene));
} else {
  const scene = JSON.parse(readFileSync(0, "utf8"));
  const cloud = { ...scene, antialiased: false, extensions: [] };
  for (const name of names) cloud[name] = new Float32Array(scene[name]);
  const options = { version: Number(rest[0]), from: frame, sh1Bits: 5, shRestBits: 4 };
  writeFileSync(rest[1], spz.saveSpzToBuffer(cloud, options));
}
