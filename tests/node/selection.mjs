// Answers what `tests/studio/test_edit.py` asks about selection.js: an array of calls of Selection.
import { readFileSync } from "node:fs";

const source = readFileSync(new URL("../../src/snowsplat/studio/pages/selection.js", import.meta.url), "utf-8");
const { Selection, within, outside } = await import(`data:text/javascript;base64,${Buffer.from(source).toString("base64")}`);

const { count, calls, centers, matrix, shape, width, height, box } = JSON.parse(readFileSync(0, "utf-8"));
const selection = new Selection(count);
const states = calls.map(([name, ...values]) => {
    selection[name](...values);
    return [...selection.state];
});
const places = Float32Array.from(centers);
const found = [...within(places, matrix, Uint8Array.from(shape), width, height)];
console.log(JSON.stringify({ states, deleted: selection.deleted(), found, outside: [...outside(places, ...box)] }));
