"""All measurements that need a GPU, in one run of less than nine minutes.

    python benchmarks/gpu.py --out OUT --datasets DATASETS
    python benchmarks/gpu.py --out OUT --only device stages        some of the parts

The parts are: tests that need a GPU; compute-sanitizer over every op; the stages of a training step
with their lower bounds, its memory, and the cost of sums in a fixed order; the same step with
gsplat; whole runs of `snowsplat train`; and training runs compared with the CPU.
benchmarks/README.md explains the measurements.

Each part is a process with a time limit, so a part that crashes or hangs does not affect others.
The page OUT/gpu.md is rewritten after each finding, and printed at the end. OUT/gpu.json has all
figures, OUT/gpu.log the output of the parts. Exit code: 0 on success, 1 if something failed or
exceeded its time, 2 without a GPU.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "src"))  # snowsplat need not be installed

from gpu_jobs import MARK, Finding, Job, Runner  # noqa: E402
from gpu_table import Findings, page  # noqa: E402

PARTS = Path(__file__).with_name("gpu_parts.py")
GROUPS = ("device", "tests", "sanitizer", "stages", "peer", "runs", "train", "cpu")
SIZES = ("200k", "1m", "3m")
DATASETS = ("fox", "lego400")
#: Whole runs: dataset, arguments of `snowsplat train`.
RUNS = {
    "fox": "",
    "lego400": "--background white",
    "garden648": "--recipe mcmc --iterations 10000 --densify-until 0.8 --max-gaussians 1000000",
}
TRAINING_TESTS = ("finite", "trainer_gpu", "view_graphs")


def jobs(flags: argparse.Namespace, scratch: Path) -> list[Job]:
    """The jobs in their order; those that are not timed run in parallel, before the others."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    environment = {
        "PYTHONPATH": os.pathsep.join(
            [
                str(ROOT / "src"),
                *filter(None, [str(flags.peer or ""), os.environ.get("PYTHONPATH")]),
            ]
        ),
        "PYTHONUNBUFFERED": "1",
        "TORCH_CUDA_ARCH_LIST": flags.arch,
        "SNOWSPLAT_DEVICE": "",
    }
    garden = flags.datasets / "garden_points.npz"
    if garden.is_file():
        environment["SNOWSPLAT_GARDEN"] = str(garden)
    datasets = [str(flags.datasets / name) for name in DATASETS]
    folder = ["--folder", str(scratch)]

    def job(
        name: str,
        part: list[str],
        limit: float,
        alone: bool = False,
        **more: str,
    ) -> Job:
        command = [sys.executable, str(PARTS), *part]
        return Job(name, command, limit, alone, environment={**environment, **more})

    two_threads = {"SNOWSPLAT_THREADS": "2", "OMP_NUM_THREADS": "2"}
    most = str(max(1, cores - 6))
    found = {group: [] for group in (*GROUPS, "untimed")}
    found["device"] = [job("device", ["device"], 45, alone=True)]
    if "cpu" in flags.only:
        part = ["train", *datasets, "--device", "cpu", "--seeds", *map(str, flags.seeds)]
        found["untimed"].append(job("train on the CPU", part, 200, SNOWSPLAT_THREADS=most))
    if "peer" in flags.only:
        found["untimed"].append(job("build the peer", ["peer-build"], 240))
    if {"stages", "peer"} & set(flags.only):
        found["untimed"].append(job("make scenes", ["scenes", *SIZES, *folder], 120))
    training = [ROOT / "tests" / "training" / f"test_{name}.py" for name in TRAINING_TESTS]
    for path in sorted([*ROOT.glob("tests/ops/test_*.py"), *training]):
        name = str(path.relative_to(ROOT))
        part = ["tests", name, "--done", str(scratch / f"{path.stem}.done")]
        found["tests"].append(job(name, part, 120, **two_threads))
    found["sanitizer"] = [
        job(tool, ["sanitize", tool], min(170.0, 30 * flags.minutes), **two_threads)
        for tool in ("memcheck", "racecheck", "synccheck")
    ]
    for size in ("1m", "200k", "3m"):
        found["stages"].append(job(f"stages {size}", ["stages", size, *folder], 60, alone=True))
    if "peer" in flags.only:
        found["peer"] = [
            job(f"peer {size}", ["peer", size, *folder], 50, alone=True) for size in ("1m", "200k")
        ]
    found["runs"] = [
        job(f"run {name}", ["run", str(flags.datasets / name), *more.split()], 120, alone=True)
        for name, more in RUNS.items()
    ]
    part = ["train", *datasets, "--seeds", *map(str, flags.seeds)]
    found["train"] = [job("train on the GPU", part, 100, alone=True)]
    late = []
    if "sanitizer" in flags.only:
        late.append(job("initcheck", ["sanitize", "initcheck"], 60, alone=True, **two_threads))
    if "train" in flags.only:
        part = ["train", *datasets, "--iterations", "7000"]
        late.append(job("train on the GPU, 7000 steps", part, 90, alone=True))
    wanted = {group: found[group] if group in flags.only else [] for group in GROUPS}
    # The sanitizers start first, because they take longest. The tests follow; there are many.
    parallel = [*found["untimed"], *wanted["sanitizer"], *wanted["tests"]]
    timed = [*wanted["stages"], *wanted["peer"], *wanted["runs"], *wanted["train"]]
    return [*wanted["device"], *parallel, *timed, *late]


def probe() -> Finding:
    """Whether there is a GPU: a finding of `gpu_parts.py probe`."""
    run = subprocess.run(
        [sys.executable, str(PARTS), "probe"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), *_python_path()])},
        capture_output=True,
        text=True,
        timeout=120,
    )
    for line in run.stdout.splitlines():
        if line.startswith(MARK):
            answer: Finding = json.loads(line[len(MARK) :])
            return answer
    last = (run.stderr.strip().splitlines() or ["no output"])[-1]
    return {"kind": "no gpu", "why": f"the package does not load: {last}"}


def _python_path() -> list[str]:
    return [os.environ["PYTHONPATH"]] if os.environ.get("PYTHONPATH") else []


def main() -> int:
    began = time.monotonic()
    flags = _flags()
    found = probe()
    if found["kind"] == "no gpu":
        print(f"gpu: nothing was measured: {found['why']}")
        return 2
    flags.out.mkdir(parents=True, exist_ok=True)
    findings = Findings()
    findings.add("probe", found)
    when = time.strftime("%Y-%m-%d")

    def write(running: bool = True) -> str:
        text = page(findings, runner.outcomes, when, running)
        for name, content in (
            ("gpu.md", text),
            ("gpu.json", json.dumps(findings.as_json(), indent=1) + "\n"),
        ):
            part = flags.out / f".{name}.part"
            part.write_text(content, encoding="utf-8")
            part.replace(flags.out / name)
        return text

    def on_finding(job: str, one: Finding) -> None:
        findings.add(job, one)
        nonlocal written
        if time.monotonic() - written > 1:
            write()
            written = time.monotonic()

    def say(line: str) -> None:
        print(f"{time.monotonic() - began:5.0f} s  {line}", flush=True)
        write()

    written = 0.0
    received: list[int] = []
    log = flags.out / "gpu.log"
    log.write_bytes(b"")
    with tempfile.TemporaryDirectory(prefix="snowsplat-gpu-") as scratch:
        until = began + 60 * flags.minutes - 10
        runner = Runner(Path(scratch), log, until, flags.width, on_finding, say)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda number, _: (received.append(number), runner.stop()))
        try:
            runner.run(jobs(flags, Path(scratch)))
        finally:
            print("\n" + write(running=False), flush=True)
    if received:
        return 128 + received[0]
    ok = all(outcome.state == "done" for outcome in runner.outcomes) and not findings.wrong()
    return 0 if ok else 1


def _flags() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=ROOT / "out" / "gpu", help="folder for the three output files"
    )
    parser.add_argument(
        "--datasets",
        "--captures",
        type=Path,
        default=ROOT.parent / "shared" / "captures",
        help="a folder with fox, lego400, garden648 and garden_points.npz, or some of them",
    )
    parser.add_argument("--only", nargs="+", default=list(GROUPS), choices=GROUPS)
    parser.add_argument("--minutes", type=float, default=8.8, help="time limit of the run")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1], help="of the training runs")
    parser.add_argument("--width", type=int, default=8, help="number of parallel parts")
    parser.add_argument("--peer", type=Path, metavar="DIR", help="gsplat's checkout, built here")
    parser.add_argument("--arch", default="9.0", help="of the card, to build the peer for")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
