// Answers what `tests/studio` asks about the modules of the editor: an array of calls of Edits, and places.
import { readFileSync } from "node:fs";
import { Edits } from "../../src/snowsplat/studio/pages/edits.js";
import { along, outside, project, within } from "../../src/snowsplat/studio/pages/selection.js";
import { levelling, turned } from "../../src/snowsplat/studio/pages/turning.js";

const {
    count,
    calls,
    centers,
    matrix,
    shape,
    width,
    height,
    box,
    floor,
    eye,
    drags = [],
} = JSON.parse(readFileSync(0, "utf-8"));
const edits = new Edits(count);
const steps = calls.map(([name, ...values]) => {
    edits[name](...values);
    return { ...edits.present, state: [...edits.present.state] };
});
const places = Float32Array.from(centers);
console.log(
    JSON.stringify({
        steps,
        deleted: edits.deleted(),
        counts: edits.counts(),
        found: [...within(places, matrix, Uint8Array.from(shape), width, height)],
        outside: [...outside(places, ...box)],
        level: floor.map(point => turned(levelling(floor, eye), point, eye)),
        // The place is in pixels, or that of another point of the axis.
        drags: drags.map(({ point, axis, length, place, to }) => {
            const moved = [...point];
            moved[axis] = to;
            return along(matrix, point, axis, length, place ?? project(matrix, moved, width, height), width, height);
        }),
    }),
);
