"""Times the stages of a training iteration.

    python benchmarks/stages.py                                 50k, the best instruction set
    python benchmarks/stages.py --size 50k 200k 1m small --isa all --threads 1 2
    python benchmarks/stages.py --reference                     compared with plain PyTorch
    python benchmarks/stages.py --versus avx2                   two instruction sets, alternating
    python benchmarks/stages.py --versus ../before/src          two builds, alternating

benchmarks/README.md explains the columns, and how to read them on a busy machine.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from floor import OPERATIONS, OPERATIONS_PER_CLOCK, floor_ns, system_ghz
from iteration import REST, STAGES, TOTAL
from workloads import SIZES

from snowsplat.ops import native
from snowsplat.util.errors import UserError
from snowsplat.util.machine import processor_name

Measured = dict[str, Any]
BLEND = ("blend forward", "blend backward")


class Worker:
    """A process with one library: an instruction set, optionally of another source tree."""

    def __init__(self, isa: str, source: Path | None = None) -> None:
        environment = os.environ | {"SNOWSPLAT_ISA": isa}
        script = Path(__file__).with_name("worker.py")
        if source is not None:
            environment["PYTHONPATH"] = str(source.resolve())
            # The modules of another checkout may have other names, so its own worker.py is used.
            own = source.resolve().parent / "benchmarks" / "worker.py"
            script = own if own.is_file() else script
        self._process = subprocess.Popen(
            [sys.executable, str(script)],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(
        self,
        size: str,
        threads: int,
        repeats: int,
        *,
        visible_only: bool = False,
        reference: bool = False,
        count: bool = False,
    ) -> Measured:
        """Send a request; see worker.py. Raises UserError if it fails."""
        request = {
            "size": size,
            "threads": threads,
            "repeats": repeats,
            "visible_only": visible_only,
            "reference": reference,
            "count": count,
        }
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise UserError("the measuring process has ended; its output is above")
        answer: Measured = json.loads(line)
        if "error" in answer:
            raise UserError(answer["error"])
        return answer

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


def main() -> None:
    flags = _flags()
    available = native.available_isas()
    isas = list(reversed(available)) if flags.isa == ["all"] else flags.isa or [available[-1]]
    for isa in isas:
        if isa not in available:
            raise UserError(f"--isa {isa} does not run here; there are {', '.join(available)}")
    ghz = flags.ghz or system_ghz()
    print(_machine(ghz))
    results: list[Measured] = []
    if flags.versus is not None:
        for size in flags.size:
            results += _paired(flags, size, isas[0])
    if flags.versus is None or flags.reference:
        with Worker(isas[0]) as first:
            if flags.versus is None:
                for size in flags.size:
                    results += _absolute(flags, size, isas, ghz, first)
            if flags.reference:
                results += _beside_reference(flags, isas[0], first)
    if flags.json is not None:
        flags.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


# ------------------------------------------------------------------------------------- the tables


def _absolute(
    flags: argparse.Namespace, size: str, isas: list[str], ghz: float, first: Worker
) -> list[Measured]:
    """``first`` is the worker of the first instruction set."""
    results: list[Measured] = []
    pairs = 0  # equal for all libraries
    for isa in isas:
        columns: list[Measured] = []
        with nullcontext(first) if isa == isas[0] else Worker(isa) as worker:
            for threads in flags.threads:
                found = worker.ask(
                    size,
                    threads,
                    flags.repeats,
                    visible_only=flags.visible_only,
                    count=not pairs,
                )
                pairs = found["counts"].setdefault("pairs", pairs)
                columns.append(found)
        if not results:
            _print_counts(size, columns[0])
        _print_stages(columns, ghz)
        results += columns
    best = results[0]
    for found in results:
        if found["threads"] == best["threads"] and found is not best:
            ratio = _least(found, TOTAL)[2] / _least(best, TOTAL)[2]
            print(f"{found['isa']} takes {ratio:.2f}x the processor time of {best['isa']}")
    return results


def _print_stages(columns: list[Measured], ghz: float) -> None:
    """One instruction set, a group of columns for each number of threads."""
    print()
    print(_row("", [f"{found['isa']} x{found['threads']}".rjust(23) for found in columns]))
    print(_row("ms", [f"{'min':>7}{'median':>8}{'cpu':>8}" for _ in columns]))
    for name in _ordered({name: None for found in columns for name in found["wall"]}):
        print(_row(name, [_cells(_least(found, name), 1e3) for found in columns]))
    for found in columns:
        n = found["counts"]
        found["lane_use"] = n["pairs"] / max(1, n["lanes"] * n["steps"])
        found["floor_ns"] = floor_ns(n["lanes"], max(found["lane_use"], 1e-9), ghz)
        found["pair_ns"] = [1e9 * t / max(1, n["pairs"]) for t in _blend_core_seconds(found)]
    print("blend forward + backward")
    print(_row("  ns per pair, core", [_cells(found["pair_ns"]) for found in columns]))
    shares = [[found["floor_ns"] / ns for ns in found["pair_ns"]] for found in columns]
    print(_row("  share of the floor", [_cells(share) for share in shares]))
    print(_row("  floor, ns", [f"{found['floor_ns']:>7.2f}{'':16}" for found in columns]))
    print(_row("  lane use", [f"{found['lane_use']:>7.2f}{'':16}" for found in columns]))


def _print_counts(size: str, found: Measured) -> None:
    count, width, height = SIZES[size]
    n = found["counts"]
    per_splat, per_pixel = n["instances"] / max(1, n["splats"]), n["pairs"] / (width * height)
    print(
        f"\n{size}: {count:,} Gaussians from {found['source']}, {width}x{height}\n"
        f"{n['splats']:,} visible splats, {n['instances']:,} instances ({per_splat:.1f} per splat, "
        f"{n['visited'] / max(1, n['instances']):.0%} visited), {n['pairs']:,} blended pairs "
        f"({per_pixel:.0f} per pixel)"
    )


def _paired(flags: argparse.Namespace, size: str, isa: str) -> list[Measured]:
    """Measure A and B alternately, so that the load of the machine affects both equally."""
    clock = "cpu" if flags.cpu_time else "wall"
    if flags.versus in native.ISAS:
        other, source, label = flags.versus, None, flags.versus
    else:
        other, source, label = isa, Path(flags.versus), flags.versus
        if not (source / "snowsplat").is_dir():
            raise UserError(
                f"--versus {flags.versus} is neither an instruction set nor a folder that holds "
                "the package snowsplat"
            )
    results: list[Measured] = []
    with Worker(isa) as a, Worker(other, source) as b:
        for threads in flags.threads:
            least: dict[str, dict[str, list[float]]] = {"a": {}, "b": {}}
            for i in range(flags.repeats):
                for side, worker in sorted({"a": a, "b": b}.items(), reverse=i % 2 == 1):
                    found = worker.ask(size, threads, 3, visible_only=flags.visible_only)
                    for name, times in found[clock].items():
                        least[side].setdefault(name, []).append(min(times))
            rounds: dict[str, list[float]] = {}
            print(f"\n{size} x{threads}: {clock} time of {label} / {isa} (A is {isa})")
            print(_row("ratio", [f"{'least':>8}{'median':>8}{'quartiles':>16}"]))
            for name in _ordered(dict.fromkeys(n for n in least["a"] if n in least["b"])):
                rounds[name] = [
                    _ratio(tb, ta)
                    for ta, tb in zip(least["a"][name], least["b"][name], strict=True)
                ]
                low, middle, high = _quartiles(rounds[name])
                of_least = _ratio(min(least["b"][name]), min(least["a"][name]))
                cells = f"{of_least:>8.3f}{middle:>8.3f}{f'{low:.3f} … {high:.3f}':>16}"
                print(_row(name, [cells]))
            results.append(
                {"size": size, "threads": threads, "a": isa, "b": label, "ratios": rounds}
            )
    return results


def _beside_reference(flags: argparse.Namespace, isa: str, worker: Worker) -> list[Measured]:
    results = []
    print(f"\n{flags.reference}: plain PyTorch (ops.reference, float32) and {isa}, one iteration")
    print(_row("ms, minimum", [f"{'reference':>10}{'native':>9}{'ratio':>8}{'cpu':>8}"]))
    for threads in flags.threads:
        own = worker.ask(flags.reference, threads, flags.repeats)
        # An iteration takes seconds, so at most three are made.
        slow = worker.ask(flags.reference, threads, min(3, flags.repeats), reference=True)
        (theirs, _, their_cpu), (ours, _, our_cpu) = (_least(f, TOTAL) for f in (slow, own))
        cells = f"{1e3 * theirs:>10.0f}{1e3 * ours:>9.2f}{theirs / ours:>7.0f}x"
        cells += f"{their_cpu / our_cpu:>7.0f}x"
        print(_row(f"{threads} thread{'s' * (threads > 1)}", [cells]))
        results.append(
            {
                "size": flags.reference,
                "threads": threads,
                "reference": slow["wall"],
                "native": own["wall"],
            }
        )
    return results


# ------------------------------------------------------------------------------------------ cells


def _least(found: Measured, name: str) -> list[float]:
    """Seconds: least and median wall time, least processor time, over the numbers of threads."""
    wall, cpu = found["wall"].get(name, [0.0]), found["cpu"].get(name, [0.0])
    return [min(wall), statistics.median(wall), min(cpu) / found["threads"]]


def _blend_core_seconds(found: Measured) -> list[float]:
    """As `_least`, for blending in both directions, times the number of cores in use."""
    wall, cpu = (
        [sum(times) for times in zip(*(found[clock][name] for name in BLEND), strict=True)]
        for clock in ("wall", "cpu")
    )
    threads = found["threads"]
    return [threads * min(wall), threads * statistics.median(wall), min(cpu)]


def _cells(values: list[float], scale: float = 1.0) -> str:
    least, middle, cpu = (scale * value for value in values)
    return f"{least:>7.2f}{middle:>8.2f}{cpu:>8.2f}"


def _row(name: str, cells: list[str]) -> str:
    return f"{name:<21}" + "  ".join(cells).rstrip()


def _ordered(names: dict[str, Any]) -> list[str]:
    known = [name for name in STAGES.values() if name in names]
    others = [name for name in names if name not in (*known, REST, TOTAL)]
    return [*known, *others, REST, TOTAL]


def _ratio(b: float, a: float) -> float:
    return b / a if a > 0 else 1.0


def _quartiles(values: list[float]) -> tuple[float, float, float]:
    if len(values) < 2:
        return values[0], values[0], values[0]
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return low, middle, high


def _machine(ghz: float) -> str:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    line = (
        f"{processor_name()}, {cores} cores, {', '.join(native.available_isas())}; "
        f"floor: {OPERATIONS} vector "
        f"operations per step, {OPERATIONS_PER_CLOCK:g} per clock, {ghz:.2f} GHz"
    )
    if hasattr(os, "getloadavg") and os.getloadavg()[0] > 0.5:
        line += (
            f"\nload average {os.getloadavg()[0]:.1f}: other processes are running; compare ratios"
        )
    return line


def _flags() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", nargs="+", default=["50k"], choices=SIZES)
    parser.add_argument("--isa", nargs="+", default=[], help="or: all (default: the best)")
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--repeats", type=int, default=10, help="iterations; rounds of --versus")
    parser.add_argument("--cpu-time", action="store_true", help="--versus compares processor time")
    parser.add_argument(
        "--visible-only", action="store_true", help="Adam updates visible rows only"
    )
    parser.add_argument("--versus", metavar="ISA|SRC", help="ratio to it, alternating")
    parser.add_argument(
        "--reference",
        "--twin",
        nargs="?",
        const="10k",
        choices=SIZES,
        metavar="SIZE",
        help="compare with the reference implementation in PyTorch",
    )
    parser.add_argument("--ghz", type=float, help="clock for the floor (default: as reported)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="store all measurements")
    flags = parser.parse_args()
    if flags.repeats < 1 or min(flags.threads) < 1:
        parser.error("--repeats and --threads must be 1 or more")
    return flags


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        sys.exit(f"stages: {error}")
