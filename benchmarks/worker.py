"""The process in which `stages.py` measures: a library stays loaded for the process's lifetime.

A request is a line of JSON on standard input, the response is a line on standard output:
{"size", "threads", "repeats", "visible_only", "reference", "count"} →
{"size", "threads", "isa", "source", "gaussians", "wall", "cpu", "counts"}, or {"error"}.
Between requests, the process sleeps.
"""

import json
import sys
from typing import Any

from iteration import Iteration, Stopwatch
from pairs import LANES, count_pairs, count_steps, frame_of
from torch import Tensor
from workloads import workload

from snowsplat.ops import Splats2D, native
from snowsplat.util.errors import UserError
from snowsplat.util.process import single_threaded


def counts(iteration: Iteration, with_pairs: bool) -> dict[str, int]:
    """Numbers of splats, instances, visited ones and steps; pairs only if requested (seconds)."""
    found: dict[str, int] = {}
    camera = iteration.workload.camera

    def inspect(splats: Splats2D, image: Tensor) -> None:
        frame = frame_of(image)
        found.update(splats=len(splats), lanes=LANES[native.isa()], **count_steps(frame))
        if with_pairs:
            found["pairs"] = count_pairs(splats, frame, camera.width, camera.height)

    with single_threaded():
        iteration.run(Stopwatch(), inspect)
    return found


def main() -> None:
    key, iteration = None, None
    for line in sys.stdin:
        request: dict[str, Any] = json.loads(line)
        try:
            wanted = (request["size"], request["visible_only"], request["reference"])
            if iteration is None or key != wanted:
                iteration = None  # release its memory first
                scene = workload(request["size"])
                key = wanted
                iteration = Iteration(
                    scene, visible_only=request["visible_only"], use_reference=request["reference"]
                )
                if not request["reference"]:
                    iteration.measure(2, request["threads"])  # warm-up: buffers, caches
            answer: dict[str, Any] = {
                "isa": native.isa(),
                "size": request["size"],
                "threads": request["threads"],
                "source": iteration.workload.source,
                "gaussians": len(iteration.workload.gaussians),
                **iteration.measure(request["repeats"], request["threads"]),
            }
            if not request["reference"]:
                answer["counts"] = counts(iteration, request["count"])
        except UserError as error:
            answer = {"error": str(error)}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
