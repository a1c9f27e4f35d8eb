// Answers what `tests/studio/test_edit.py` asks about selection.js and turning.js: an array of calls of Selection.
import { readFileSync } from "node:fs";

const read = name => readFileSync(new URL(`../../src/snowsplat/studio/pages/${name}`, import.meta.url), "utf-8");
const address = source => `data:text/javascript;base64,${Buffer.from(source).toString("base64")}`;
const turning = address(read("turning.js"));
const { Selection, within, outside } = await import(address(read("selection.js").replace("./turning.js", turning)));
const { levelling, turned } = await import(turning);

const { count, calls, centers, matrix, shape, width, height, box, floor, eye } = JSON.parse(readFileSync(0, "utf-8"));
const selection = new Selection(count);
const turns = [];
const states = calls.map(([name, ...values]) => {
    selection[name](...values);
    turns.push(selection.turn);
    return [...selection.state];
});
const places = Float32Array.from(centers);
const found = [...within(places, matrix, Uint8Array.from(shape), width, height)];
console.log(JSON.stringify({ states, deleted: selection.deleted(), found, outside: [...outside(places, ...box)], turns, level: floor.map(point => turned(levelling(floor, eye), point, eye)) }));
