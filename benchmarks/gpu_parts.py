"""The parts of `gpu.py`, each in its own process: `python gpu_parts.py PART …` prints findings.

It imports only those modules of the package that need no other packages than PyTorch, numpy, Pillow
and cuda-bindings.
"""

import argparse
import json
import os
import re
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gpu_jobs import finding

ROOT = Path(__file__).resolve().parents[1]
RATE = Path(__file__).with_name("gpu_rate.cu")
#: Datasets with transparent images.
BACKGROUNDS = {"lego400": "white"}


# ------------------------------------------------------------------------------------ the machine


def probe() -> None:
    """Report whether the package can use a GPU, and which."""
    from snowsplat.ops.cuda.availability import why_unusable

    why = why_unusable()
    if why is not None:
        finding("no gpu", why=why)
        return
    import torch

    finding("gpu", name=torch.cuda.get_device_name(0))


def device() -> None:
    import torch

    card = torch.cuda.get_device_properties(0)
    finding(
        "device",
        name=card.name,
        capability=f"{card.major}.{card.minor}",
        multiprocessors=card.multi_processor_count,
        memory_gb=card.total_memory / 1e9,
        l2_mb=getattr(card, "L2_cache_size", 0) / 1e6,
        torch=torch.__version__,
        python=sys.version.split()[0],
        cores=len(os.sched_getaffinity(0)),
        kernels=_built_kernels(card.major, card.minor),
        clocks=_clocks(),
    )
    finding("bandwidth", bytes_a_second=_copy_bandwidth())
    try:
        rate = _multiply_add_rate()
        finding("rate", operations_a_second=rate, clocks=_clocks())
    except Exception as error:  # then the lower bounds are those of bytes alone
        print(f"multiply-adds were not measured: {error!r}")
    finding("mark", milliseconds=_mark_time())


def _built_kernels(major: int, minor: int) -> str:
    built = ROOT / "src" / "snowsplat" / "_lib" / "cuda"
    for lower in range(minor, -1, -1):
        if (built / f"sm_{10 * major + lower}").is_dir():
            return f"built for sm_{10 * major + lower}"
    return "compiled at first use"


def _clocks() -> str:
    """State of the card from nvidia-smi; nothing is changed."""
    wanted = "driver_version,clocks.sm,clocks.max.sm,clocks.mem,power.draw,temperature.gpu"
    try:
        run = subprocess.run(
            ["nvidia-smi", f"--query-gpu={wanted}", "--format=csv,noheader", "--id=0"],
            capture_output=True,
            text=True,
            timeout=20,
        )
    except (OSError, subprocess.TimeoutExpired):
        return "nvidia-smi does not respond"
    values = [value.strip() for value in run.stdout.split(",")]
    if run.returncode != 0 or len(values) != 6:
        return "nvidia-smi does not respond"
    driver, sm, most, memory, power, temperature = values
    return f"driver {driver}, SM {sm} of {most}, memory {memory}, {power}, {temperature} °C"


def _copy_bandwidth() -> float:
    """Bytes read and written per second, by copies much larger than the caches."""
    import gpu_step
    import torch

    free, _ = torch.cuda.mem_get_info()
    count = min(2 << 30, free // 4)
    source = torch.empty(count, dtype=torch.uint8, device=gpu_step.GPU).random_()
    target = torch.empty_like(source)
    for _ in range(3):
        target.copy_(source)
    times = gpu_step.gpu_times(lambda: target.copy_(source), 15)
    return 2 * count / (1e-3 * statistics.median(times))


def _multiply_add_rate() -> float:
    """Multiply-adds per second, by gpu_rate.cu."""
    import torch
    from gpu_step import gpu_times

    from snowsplat.ops.cuda import driver, nvrtc
    from snowsplat.ops.cuda.kernels import Kernel

    name, threads, a_loop = "multiply_adds", 256, 8 * 32
    card = torch.cuda.get_device_properties(0)
    code, _ = nvrtc.Nvrtc(nvrtc.find()).compile(RATE, f"sm_{card.major}{card.minor}")
    gpu = driver._gpu(0)
    with gpu.current():
        library = gpu._check(gpu.cuda.cuLibraryLoadData(code, None, None, 0, None, None, 0))
    gpu._libraries["gpu_rate"] = library  # where `driver.run` finds the code of the kernel
    blocks, loops = 64 * card.multi_processor_count, 400
    numbers = torch.tensor([0.999, 0.001], device="cuda")
    out = torch.empty(blocks * threads, device="cuda")
    kernel = Kernel("gpu_rate", threads=threads, items=1)

    def work() -> None:
        driver.run(kernel, name, blocks, {"n": loops, "numbers": numbers, "out": out})

    for _ in range(3):
        work()
    milliseconds = statistics.median(gpu_times(work, 9))
    return blocks * threads * loops * a_loop / (1e-3 * milliseconds)


def _mark_time() -> float:
    """Milliseconds between two events with nothing between them; part of every kernel's time."""
    from gpu_step import gpu_times

    return statistics.median(gpu_times(lambda: None, 21))


# ------------------------------------------------------------------------------------------ tests


@dataclass(eq=False)  # pytest needs to hash it
class Reporter:
    """A pytest plugin: reports each failure at once, and counts the tests.

    ``done`` is a file that lists the finished tests. If a test leaves the GPU unusable for this
    process, the remaining tests need another process: then `lost` is True.
    """

    done: Path
    outcomes: dict[str, str] = field(default_factory=dict)
    lost: bool = False
    total: int = 0
    session: Any = None

    def __post_init__(self) -> None:
        if self.done.exists():
            lines = self.done.read_text(encoding="utf-8").splitlines()
            self.outcomes = dict(reversed(line.split(" ", 1)) for line in lines)

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items[:] = [item for item in items if item.nodeid not in self.outcomes]

    def pytest_collection_finish(self, session: Any) -> None:
        self.total = len(self.outcomes) + len(session.items)

    def pytest_sessionstart(self, session: Any) -> None:
        self.session = session

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed:
            self._failure(report)

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self._failure(report)
            self._note(report.nodeid, "failed")
            self.lost = gpu_is_lost()
            if self.lost:
                self.session.shouldstop = "the GPU is unusable in this process"
        elif report.when == "call" or report.skipped:
            self._note(report.nodeid, report.outcome)

    def counts(self) -> dict[str, int]:
        outcomes = list(self.outcomes.values())
        return {name: outcomes.count(name) for name in ("passed", "failed", "skipped")}

    def _failure(self, report: Any) -> None:
        crash = getattr(report.longrepr, "reprcrash", None)
        text = crash.message if crash is not None else str(report.longrepr)
        lines = [line.strip() for line in text.splitlines() if line.strip()] or ["no message"]
        # If a file cannot be collected, the error is on the last line.
        line = lines[0] if crash is not None else lines[-1].removeprefix("E").strip()
        finding("failure", test=report.nodeid, line=line[:200])
        print(report.longreprtext)

    def _note(self, test: str, outcome: str) -> None:
        if self.outcomes.get(test) == "failed":
            return
        self.outcomes[test] = outcome
        with self.done.open("a", encoding="utf-8") as file:
            file.write(f"{outcome} {test}\n")
        finding("tests", **self.counts(), total=self.total)


def gpu_is_lost() -> bool:
    """Whether a kernel's error has made the GPU unusable for this process."""
    import torch

    try:
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
    except RuntimeError:
        return True
    return False


_MOST_PROCESSES = 5


def tests(path: str, marker: str, done: Path, attempt: int) -> None:
    """Run the tests of a file that have a marker, in a new process after a lost GPU."""
    import pytest

    os.chdir(ROOT)
    reporter = Reporter(done)
    code = pytest.main(
        [
            "-o",
            "addopts=--import-mode=importlib",
            "-q",
            "-s",  # print findings while tests run
            "-p",
            "no:cacheprovider",
            "-m",
            marker,
            path,
        ],
        plugins=[reporter],
    )
    finding("tests", **reporter.counts(), total=reporter.total)
    if reporter.lost and attempt < _MOST_PROCESSES:
        sys.stdout.flush()
        again = [path, "--marker", marker, "--done", str(done), "--attempt", str(attempt + 1)]
        os.execv(sys.executable, [sys.executable, __file__, "tests", *again])
    # Failures are reported as findings. A file without tests of this marker is fine.
    if code not in (0, 1, 2, 5) or (code == 2 and not reporter.lost):
        raise SystemExit(f"pytest returned {int(code)}")


# ---------------------------------------------------------------------------------- the sanitizer


def ops(small: bool) -> None:
    """The program that runs under the sanitizer. ``small``: without the largest scenes."""
    import torch
    from gpu_ops import MEDIUM, SIZES, every_op

    every_op(
        torch.device("cuda"),
        MEDIUM if small else SIZES,
        wide=not small,
        say=lambda line: print(line, flush=True),
    )
    torch.cuda.synchronize()
    print(OPS_DONE, flush=True)


OPS_DONE = "all ops ran"
_SANITIZER_LINE = re.compile(r"=========\s?(.*)")
_ERRORS = re.compile(r"(?:ERROR|RACECHECK) SUMMARY: (\d+)")
_NO_ERROR = ("COMPUTE-SANITIZER", "Target application", "LEAK SUMMARY")


class SanitizerLog:
    """Parses the output of compute-sanitizer, line by line.

    Attributes:
        errors: the sanitizer's own count; before that is known, the number of errors so far.
        first: first lines of the first few errors.
        last: the last operation of the program.
        finished: whether the program ended normally.
    """

    def __init__(self, most: int = 4) -> None:
        self.errors, self.finished = 0, False
        self.first: list[str] = []
        self.last = ""
        self.counted = False
        self._most = most
        self._begins = True  # the next line is the first of an error
        self._second = False

    def read(self, line: str) -> bool:
        """Parse a line; returns whether there is something new to report."""
        match = _SANITIZER_LINE.match(line)
        if match is None:
            self.finished = self.finished or line.strip() == OPS_DONE
            if line.startswith(("ops:", "training:")):
                self.last = line.strip()
            return False
        text = match[1].strip()
        summary = _ERRORS.match(text)
        if summary is not None:
            # A second summary has the number of errors that were not printed.
            count = int(summary[1])
            self.errors, self.counted = max(count, self.errors if self.counted else 0), True
            return True
        if not text:
            self._begins = True
            return False
        if text.startswith(_NO_ERROR):
            return False
        begins, self._begins = self._begins, False
        if begins:
            self.errors += 1
            if len(self.first) < self._most:
                self.first.append(text[:160])
                self._second = True
            return True
        if self._second:  # the location of the error
            self.first[-1] += f", {text[:80]}"
            self._second = False
        return False

    def report(self, tool: str) -> None:
        finding(
            "sanitizer",
            tool=tool,
            errors=self.errors,
            counted=self.counted,
            lines=self.first,
            last=self.last,
            finished=self.finished,
        )


def sanitize(tool: str) -> None:
    sanitizer = find_tool("compute-sanitizer")
    if sanitizer is None:
        raise SystemExit("compute-sanitizer is missing")
    environment = dict(os.environ)
    if tool in ("memcheck", "initcheck"):
        # Allocate each tensor separately, so that accesses beyond its end are detected.
        environment["PYTORCH_NO_CUDA_MEMORY_CACHING"] = "1"
    command = [sanitizer, "--tool", tool, "--print-limit", "20"]
    if tool == "memcheck":
        command += ["--report-api-errors", "no"]  # torch makes calls that may fail
    program = ["ops", *(["--small"] if tool == "racecheck" else [])]  # it is 100 times slower
    log = SanitizerLog()
    with subprocess.Popen(
        [*command, sys.executable, __file__, *program],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env=environment,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            if log.read(line):
                log.report(tool)
    log.report(tool)
    if not log.finished:
        raise SystemExit(f"the program ended ({process.returncode}) at: {log.last or 'the start'}")


def find_tool(name: str) -> str | None:
    """Path of a program of the CUDA toolkit."""
    homes = [os.environ.get("CUDA_HOME", ""), "/usr/local/cuda"]
    folders = [f"{home}/bin" for home in homes if home]
    return shutil.which(name, path=os.pathsep.join([os.environ.get("PATH", ""), *folders]))


# ------------------------------------------------------------------------------------------ times


def scenes(sizes: Iterable[str], folder: Path) -> None:
    """Prepare workloads in advance, since that uses the CPU."""
    import torch
    from workloads import workload

    for size in sizes:
        path = _scene_path(folder, size)
        torch.save(workload(size), path.with_suffix(".part"))
        path.with_suffix(".part").rename(path)
        print(f"{size} is ready", flush=True)


def _scene_path(folder: Path, size: str) -> Path:
    return folder / f"{size}.scene"


def _scene(folder: Path, size: str) -> Any:
    import torch
    from workloads import workload

    path = _scene_path(folder, size)
    return torch.load(path, weights_only=False) if path.exists() else workload(size)


def stages(size: str, folder: Path, repeats: int) -> None:
    import torch
    from gpu_step import GPU, Step, stage_times, step_times, sums_in_order

    from snowsplat.ops.cuda import driver

    scene = _scene(folder, size)
    finding("scene", size=size, source=scene.source)
    step = Step(scene, GPU)
    for _ in range(4):  # warm-up: capacity for the instances, kernels, torch's memory
        step.run()
    counts = step.counts()
    # The memory of a recorded graph is reserved, but it does not count as allocated.
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    for _ in range(3):
        step.run()
    torch.cuda.synchronize()
    allocated, peak = torch.cuda.memory_allocated(), torch.cuda.max_memory_reserved()
    finding("frame", size=size, **counts)
    finding("memory", size=size, allocated=allocated, peak=peak)
    for in_order in (False, True):
        with sums_in_order(in_order):
            for _ in range(3):
                step.run()
            found = {"size": size, "in_order": in_order, "repeats": repeats}
            times = step_times(step, repeats)
            with step.without_graphs():
                step.run()
                plain = step_times(step, repeats)
            with step.visible_only():
                step.run()
                visible = step_times(step, repeats)
            finding("step", **found, **times, plain=plain, visible=visible)
            kernels = stage_times(step, driver.run, repeats)
            finding("stages", size=size, in_order=in_order, kernels=kernels)


# --------------------------------------------------------------------------------------- training


def train(
    datasets: Iterable[Path], seeds: Iterable[int], device: str, iterations: int | None
) -> None:
    """Held-out PSNR, time and memory of the default recipe; all datasets for each seed."""
    for seed in seeds:
        for path in datasets:
            if path.is_dir():
                _train(path, seed, device, iterations)
            elif seed == 0:
                finding("absent", dataset=path.name)


def _train(path: Path, seed: int, name: str, iterations: int | None) -> None:
    import torch

    from snowsplat import Trainer, evaluate_views, load_dataset, recipe

    device = torch.device(name)
    on_gpu = device.type == "cuda"
    dataset = load_dataset(path)
    background: Any = BACKGROUNDS.get(path.name, "black")
    config = recipe(
        "default",
        seed=seed,
        test_iterations=(),
        background=background,
        **({} if iterations is None else {"iterations": iterations}),
    )
    if on_gpu:
        torch.cuda.synchronize()  # initialises the GPU before memory is measured
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    begin = time.perf_counter()
    trainer = Trainer(dataset, config, device=device)
    trainer.run()
    if on_gpu:
        torch.cuda.synchronize()
    seconds = time.perf_counter() - begin
    if on_gpu:
        peak = torch.cuda.max_memory_allocated()
    else:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    found = trainer.evaluate()
    psnr_on_cpu = None
    if on_gpu:  # evaluate the same scene on the CPU
        color = (1.0 if background == "white" else 0.0,) * 3
        psnr_on_cpu = evaluate_views(
            trainer.gaussians.to("cpu"), dataset.test, background=color
        ).psnr
    finding(
        "training",
        dataset=path.name,
        device=device.type,
        seed=seed,
        iterations=config.iterations,
        psnr=found.psnr,
        ssim=found.ssim,
        psnr_on_cpu=psnr_on_cpu,
        seconds=seconds,
        gaussians=len(trainer.gaussians),
        peak=peak,
    )


def whole_run(path: Path, arguments: list[str]) -> None:
    """Time and result of a whole `snowsplat train`, from the start of its process to its end."""
    if not path.is_dir():
        finding("absent", dataset=path.name)
        return
    with tempfile.TemporaryDirectory(prefix="snowsplat-run-") as folder:
        command = [sys.executable, "-m", "snowsplat", "train", str(path), "-o", f"{folder}/out"]
        command += ["--eval", "--device", "cuda", *arguments]
        begin = time.perf_counter()
        run = subprocess.run(command, capture_output=True, text=True)
        seconds = time.perf_counter() - begin
        print(run.stdout + run.stderr)
        if run.returncode != 0:
            raise SystemExit(f"{' '.join(command)} returned {run.returncode}")
        metrics = json.loads(Path(folder, "out", "metrics.json").read_text(encoding="utf-8"))
        (scene,) = Path(folder, "out").glob("point_cloud/*/point_cloud.ply")
        with scene.open("rb") as file:
            header = file.read(4096).partition(b"end_header")[0].decode()
    # "… 2,000 steps in 4.1 s, at most …": without the start and the evaluation
    steps = re.search(r"([\d,]+) steps in ([\d.]+) s", run.stdout)
    finding(
        "run",
        dataset=path.name,
        arguments=" ".join(arguments),
        seconds=seconds,
        steps=int(steps[1].replace(",", "")) if steps else None,
        training=float(steps[2]) if steps else None,
        gaussians=int(header.partition("element vertex ")[2].split()[0]),
        **{name: metrics[name] for name in ("psnr", "ssim", "size")},
    )


# ------------------------------------------------------------------------------------------- main


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parts = parser.add_subparsers(dest="part", required=True)
    for name in ("probe", "device", "peer-build"):
        parts.add_parser(name)
    part = parts.add_parser("ops")
    part.add_argument("--small", action="store_true")
    part = parts.add_parser("tests")
    part.add_argument("path")
    part.add_argument("--marker", default="gpu")
    part.add_argument("--done", type=Path, required=True)
    part.add_argument("--attempt", type=int, default=1)
    part = parts.add_parser("sanitize")
    part.add_argument("tool")
    part = parts.add_parser("scenes")
    part.add_argument("sizes", nargs="+")
    part.add_argument("--folder", type=Path, required=True)
    part = parts.add_parser("stages")
    part.add_argument("size")
    part.add_argument("--folder", type=Path, required=True)
    part.add_argument("--repeats", type=int, default=30)
    part = parts.add_parser("peer")
    part.add_argument("size")
    part.add_argument("--folder", type=Path, required=True)
    part.add_argument("--repeats", type=int, default=20)
    part = parts.add_parser("train")
    part.add_argument("datasets", metavar="dataset", nargs="+", type=Path)
    part.add_argument("--seeds", nargs="+", type=int, default=[0])
    part.add_argument("--device", default="cuda")
    part.add_argument("--iterations", type=int)
    part = parts.add_parser("run")
    part.add_argument("dataset", type=Path)
    part.add_argument("arguments", nargs=argparse.REMAINDER, help="of snowsplat train")
    return parser.parse_args(arguments)


def main() -> None:
    flags = parse(sys.argv[1:])
    match flags.part:
        case "probe":
            probe()
        case "device":
            device()
        case "ops":
            ops(flags.small)
        case "tests":
            tests(flags.path, flags.marker, flags.done, flags.attempt)
        case "sanitize":
            sanitize(flags.tool)
        case "scenes":
            scenes(flags.sizes, flags.folder)
        case "stages":
            stages(flags.size, flags.folder, flags.repeats)
        case "train":
            train(flags.datasets, flags.seeds, flags.device, flags.iterations)
        case "run":
            whole_run(flags.dataset, flags.arguments)
        case "peer-build":
            import gpu_peer

            gpu_peer.build()
        case "peer":
            import gpu_peer

            gpu_peer.compare(_scene(flags.folder, flags.size), flags.size, flags.repeats)


if __name__ == "__main__":
    main()
