"""`benchmark`: trains and evaluates all scenes of a folder."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from snowsplat.data.readers import transforms_json
from snowsplat.evaluation.lpips import Lpips, is_packaged
from snowsplat.pipeline.benchmark.benchmark_page import BenchmarkReport, write_report
from snowsplat.pipeline.benchmark.job import SUITES, Job, SceneResult, run, suite_of
from snowsplat.pipeline.options.benchmark import BenchmarkOptions
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.messages import Message, as_message, message
from snowsplat.util.run_lock import InUse


def benchmark(
    folder: Path | str,
    output: Path | str,
    options: BenchmarkOptions | None = None,
    *,
    on_line: Callable[[Message], None] = lambda line: None,
) -> BenchmarkReport:
    """Train and evaluate all scenes of a folder, by the protocol of a benchmark suite.

    Each scene has a folder in ``output``. Scenes that are finished are not repeated, and scenes
    that were interrupted continue from their last checkpoint. Several computers may call this at
    the same time with the same folders: each trains the scenes that no other one trains.

    Args:
        folder: contains one folder for each scene, see `snowsplat.data.load_dataset`.
        output: a folder for the scenes and tables. It is created if it does not exist.
        on_line: receives lines of information.

    Returns:
        The results, also written as results.json, results.csv, results.tex and index.html.

    Raises:
        UserError: no scenes, unusable options, or results that were made with other settings; or
            other processes train all the scenes that are not finished.
        KeyboardInterrupt: Ctrl-C; the same call continues.
    """
    folder, output, options = Path(folder), Path(output), options or BenchmarkOptions()
    datasets = find_scenes(folder, options.scenes)
    name = options.suite or suite_of(path.name for path in datasets)
    jobs = [_job(path, output / path.name, name, options) for path in datasets]
    finished = {job.scene for job in jobs if SceneResult.read(job) is not None}
    if options.lpips is not None:
        try:  # what is wrong is reported before hours of training
            Lpips.load(options.lpips)
        except UserError as error:
            raise SettingError("lpips", as_message(error)) from None
    output.mkdir(parents=True, exist_ok=True)
    on_line(
        message(
            "{suite}: {scenes} scenes, {finished} finished",
            suite=SUITES[name].title,
            scenes=len(jobs),
            finished=len(finished),
        )
    )
    waiting = [job for job in jobs if job.scene not in finished]
    failures, elsewhere = _run_all(waiting, options, on_line)
    results = [result for job in jobs if (result := SceneResult.read(job)) is not None]
    report = BenchmarkReport(name, results, failures)
    write_report(output, report)
    if elsewhere and len(elsewhere) == len(waiting):
        raise elsewhere[0]
    return report


def find_scenes(folder: Path, only: Sequence[str] = ()) -> list[Path]:
    """The folders of scenes in ``folder``.

    Raises: UserError: there are none, or one of ``only`` is missing.
    """

    def is_dataset(path: Path) -> bool:
        return (path / "sparse").is_dir() or bool(transforms_json.find(path))

    if not folder.is_dir():
        raise UserError("{folder}: no such folder", folder=folder)
    found = {path.name: path for path in sorted(folder.iterdir()) if is_dataset(path)}
    missing = [name for name in only if name not in found]
    if missing:
        raise UserError(
            "{folder}: contains no dataset {missing}", folder=folder, missing=missing[0]
        )
    if not found:
        if is_dataset(folder):
            raise UserError("{folder}: is a dataset itself; use the folder above", folder=folder)
        raise UserError("{folder}: contains no folders of datasets", folder=folder)
    return [found[name] for name in only] or list(found.values())


def _job(dataset: Path, output: Path, name: str, options: BenchmarkOptions) -> Job:
    suite, weights = SUITES[name], options.lpips
    if weights is not None and not is_packaged(weights):
        weights = weights.absolute()
    return Job(
        dataset.name,
        str(dataset.absolute()),
        str(output.absolute()),
        options.recipe,
        {**suite.settings, **options.settings},
        resolution=options.resolution or suite.resolutions.get(dataset.name),
        lpips=None if weights is None else str(weights),
    )


def _run_all(
    jobs: Sequence[Job], options: BenchmarkOptions, on_line: Callable[[Message], None]
) -> tuple[dict[str, str], list[InUse]]:
    """Run the jobs that nobody else runs; returns the errors by scene, and who runs the others."""
    devices = _devices(options)
    threads = None if options.jobs == 1 else max(1, (os.cpu_count() or 1) // options.jobs)
    failures: dict[str, str] = {}
    elsewhere: list[InUse] = []
    stopped = False

    def work(job: Job) -> None:
        if stopped:
            return
        device = devices.pop()
        try:
            run(job, device, threads)
        except UserError as error:
            on_line(error.message)
            if isinstance(error, InUse):
                elsewhere.append(error)
            else:
                failures[job.scene] = str(error)
            return
        finally:
            devices.append(device)
        result = SceneResult.read(job)
        assert result is not None
        on_line(
            message(
                "{scene}: {psnr:.2f} dB at {width}x{height}, SSIM {ssim:.4f}, {gaussians:,} "
                "Gaussians, {seconds:.0f} s",
                scene=job.scene,
                psnr=result.psnr,
                width=result.size[0],
                height=result.size[1],
                ssim=result.ssim,
                gaussians=result.gaussians,
                seconds=result.seconds,
            )
        )

    with ThreadPoolExecutor(options.jobs) as pool:
        running = [pool.submit(work, job) for job in jobs]
        try:
            for each in running:
                each.result()
        except KeyboardInterrupt:  # the processes get it, too, and save a checkpoint
            stopped = True
            raise
    return failures, elsewhere


def _devices(options: BenchmarkOptions) -> list[str | None]:
    """The device of each job."""
    count = torch.cuda.device_count() if options.device in (None, "cuda") else 0
    if count == 0:
        return [options.device] * options.jobs
    return [f"cuda:{number % count}" for number in range(options.jobs)]
