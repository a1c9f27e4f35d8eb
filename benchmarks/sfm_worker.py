"""The process in which `sfm.py` makes a dataset; measures the times of the stages and the memory.

The job is one line of JSON on standard input: "inputs", "folder" and "options", which are fields of
`SfmOptions`. The response is one line of JSON on standard output: "stages", "peak_mb" (of COLMAP's
process), and "result" or "error". "stages" has the wall time and the processor time of each stage
in seconds; processor time includes all threads and child processes.

Only `make_dataset` and its progress are used, so the process can run other builds of the package.
"""

import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

from snowsplat.sfm.make_dataset import make_dataset
from snowsplat.sfm.options import DatasetOptions, SfmOptions
from snowsplat.sfm.progress import Report
from snowsplat.util.errors import UserError

_TICKS = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100
_SAMPLE_SECONDS = 0.05
_STAGES = {"photos": "decode", "images": "undistort", "report": "report"}
# The items that the progress of the stage "poses" counts -> the name of the part in the tables.
_COUNTED = {
    "photos with features": "features",
    "matched pairs": "match",
    "verified pairs": "match",
    "registered photos": "map",
}
_BEFORE = "start"  # the time until the first progress of a stage, mainly to start COLMAP's process
# Parts without a progress of their own: (the part before, the part after) -> name.
_BETWEEN = {("features", "match"): "choose pairs"}


class Stopwatch:
    """A `Watcher` of `make_dataset` that adds up the times of the parts."""

    def __init__(self) -> None:
        self.stages: dict[str, dict[str, float]] = {}
        self.memory = PeakMemory()  # of the processes of the stage "poses"
        self._now = _BEFORE
        self._last = (time.perf_counter(), processor_time())

    def begin(self, stage: str) -> Report:
        self._switch(_STAGES.get(stage, _BEFORE))
        if stage == "poses":
            self.memory.start()

        def report(done: int, total: int, what: str = "", left: float | None = None) -> None:
            if stage == "poses":
                self._switch(_COUNTED.get(what, what))

        return report

    def end(self, stage: str, outcome: object) -> None:
        self._switch(_BEFORE)
        if stage == "poses":
            self.memory.stop()

    def note(self, line: str) -> None:
        pass

    def show_poses(self, photos: object, points: object) -> None:
        pass

    def _switch(self, to: str) -> None:
        """Add the time since the last call to the stage that was running."""
        now = (time.perf_counter(), processor_time())
        times = self.stages.setdefault(
            _BETWEEN.get((self._now, to), self._now), {"wall": 0.0, "cpu": 0.0}
        )
        times["wall"] += now[0] - self._last[0]
        # When a child process ends, its processor time may be missing from the sum for a moment.
        times["cpu"] += max(0.0, now[1] - self._last[1])
        self._now, self._last = to, now


def _descendants(pid: str = "self") -> list[str]:
    """The ids of all running descendants of a process; none where there is no /proc."""
    found = []
    for file in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            children = file.read_text().split()
        except OSError:  # the thread has ended
            continue
        for child in children:
            found += [child, *_descendants(child)]
    return found


def processor_time() -> float:
    """Seconds of processor time of this process and of all its descendants so far."""
    times = os.times()
    total = times.user + times.system + times.children_user + times.children_system
    for pid in _descendants():
        try:
            # The name of the program, in brackets, may contain spaces.
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        total += sum(int(field) for field in fields[11:15]) / _TICKS
    return total


def _peak_mb(pid: str) -> float:
    """The peak memory of a process so far; 0 if it is unknown."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")), 0.0)


def _command(pid: str) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


class PeakMemory:
    """Observes the largest peak memory of a descendant, in MB, between `start` and `stop`."""

    def __init__(self) -> None:
        self.peak = 0.0
        self._own = _command("self")
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._observe, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._end.set()
        self._thread.join()

    def _observe(self) -> None:
        while not self._end.wait(_SAMPLE_SECONDS):
            # After a fork and before the new program starts, the memory is that of this process.
            started = [pid for pid in _descendants() if _command(pid) not in (b"", self._own)]
            self.peak = max([self.peak, *map(_peak_mb, started)])


def main() -> None:
    job: dict[str, Any] = json.loads(sys.stdin.readline())
    options = DatasetOptions(sfm=SfmOptions(**job["options"]))
    watch, answer = Stopwatch(), dict[str, Any]()
    try:
        inputs = [Path(path) for path in job["inputs"]]
        outcomes = make_dataset(inputs, Path(job["folder"]), options, watch)
        answer["result"] = outcomes["poses"].result
    except UserError as error:
        answer["error"] = str(error)
        watch.end("", None)
    answer |= {"stages": watch.stages, "peak_mb": watch.memory.peak}
    print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
