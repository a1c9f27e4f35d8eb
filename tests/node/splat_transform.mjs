// The command line of splat-transform, for many conversions in one process.
//
// A line on stdin is a JSON list of arguments. The answer is a line on stdout: a JSON object with
// the exit code and the output of the program.
import { writeSync } from "node:fs";
import { syncBuiltinESMExports } from "node:module";
import process from "node:process";
import { createInterface } from "node:readline";

let code, output;
process.exit = (number = 0) => {
    code ??= number; // the program catches the exception, prints it and exits again
    throw new Error("exit");
};
syncBuiltinESMExports();
for (const stream of [process.stdout, process.stderr]) {
    stream.write = text => {
        if (code === undefined) output += text;
        return true;
    };
}
// This file is no export of the package, so it is imported by its path.
const { main } = await import("./node_modules/@playcanvas/splat-transform/dist/cli.mjs");
for await (const line of createInterface({ input: process.stdin })) {
    [code, output] = [undefined, ""];
    process.argv.splice(2, Infinity, ...JSON.parse(line));
    await main().catch(error => process.stderr.write(String(error.stack)));
    for (const event of ["uncaughtException", "unhandledRejection"]) {
        process.removeAllListeners(event); // each run adds one
    }
    writeSync(1, `${JSON.stringify({ code, output })}\n`);
}
