"""One scene of a benchmark: training and evaluation, in a process of its own.

The process has its own peak memory, and if it fails, the other scenes are not affected.
"""

from __future__ import annotations

import _thread
import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from snowsplat.data import ImageLoader
from snowsplat.evaluation.lpips import Lpips
from snowsplat.evaluation.metrics import Evaluation, renderings
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output.scene_source import TrainedScene, load_trained
from snowsplat.pipeline.render import evaluate
from snowsplat.pipeline.train import resume, train
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.scene.render import to_8bit
from snowsplat.training.core.history import History
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path, write_json
from snowsplat.util.interrupts import ended_by_signals, ended_together
from snowsplat.util.machine import peak_bytes, processor_name
from snowsplat.util.own_files import import_own_files, own_files
from snowsplat.util.run_lock import InUse, locked
from snowsplat.util.safe_json import from_json, read_json

RESULT = "benchmark.json"  # in the output folder of a scene
TAKEN = 75  # the exit code if another process trains the scene
_WAIT_SECONDS = 15.0  # a process whose benchmark was killed ends within this time
#: A picture of the view with the lowest PSNR: the photo, and its rendering to the right.
WORST = "worst.jpg"
_SIDE = 480  # pixels of the longer side of an image in it
_CHECKPOINT_SECONDS = 60.0


@dataclass(frozen=True)
class Job:
    """A scene and how to train it; see `TrainOptions`. Paths are absolute."""

    scene: str
    dataset: str
    output: str
    recipe: str
    settings: dict[str, Any] = field(default_factory=dict)
    resolution: int | None = None
    hold_out: int = 8  # unless the dataset has a split of its own
    lpips: str | None = None
    imports: list[str] = field(default_factory=own_files)  # see `--import`

    @property
    def result(self) -> Path:
        return Path(self.output) / RESULT


@dataclass(frozen=True)
class SceneResult:
    """The result of a scene."""

    job: Job  # the settings with which it was made
    psnr: float
    ssim: float
    lpips: float | None  # None if no weights were given
    gaussians: int
    seconds: float  # duration of the training, including interrupted runs
    memory: int  # peak memory of the process in bytes
    photos: tuple[int, int]  # number of training photos, and of test photos
    size: tuple[int, int]  # width and height of the first test photo
    worst: str
    machine: str  # the processor or GPU

    @staticmethod
    def read(job: Job) -> SceneResult | None:
        """The result of an earlier run, if there is one.

        Raises: UserError: it is damaged, or was made with other settings.
        """
        if not job.result.is_file():
            return None
        try:
            result = from_json(SceneResult, read_json(job.result))
        except ValueError as error:
            raise UserError(
                "{result}: is damaged ({error}); remove it", result=job.result, error=error
            ) from None
        if {**asdict(result.job), "dataset": ""} != {**asdict(job), "dataset": ""}:
            raise UserError(
                "{result}: was made with other settings; use another output folder, or remove "
                "{output}",
                result=job.result,
                output=job.output,
            )
        return result


def run(job: Job, device: str | None, threads: int | None) -> None:
    """Run the job in a new process.

    Raises:
        InUse: another process trains the scene.
        UserError: it failed; the message is its last line.
    """
    request = json.dumps({"job": asdict(job), "device": device, "threads": threads})
    command = [sys.executable, "-m", "snowsplat.pipeline.benchmark.job"]
    pipe = subprocess.PIPE
    # The encoding of the streams may differ from that of the locale (PYTHONIOENCODING).
    with (
        subprocess.Popen(command, stdin=pipe, stderr=pipe, text=True, errors="replace") as process,
        ended_together(process),
    ):
        assert process.stdin is not None
        assert process.stderr is not None
        process.stdin.write(request + "\n")
        process.stdin.flush()  # it stays open: its end tells that this process has ended
        lines = process.stderr.read().strip().splitlines()
        code = process.wait()
    last = (lines or [f"ended with exit code {code}"])[-1]
    if code == TAKEN:
        raise InUse(last)
    if code != 0:
        raise UserError(
            "{scene}: {removeprefix}",
            scene=job.scene,
            removeprefix=last.removeprefix("snowsplat: "),
        )


def work(job: Job, device: str | None, threads: int | None) -> None:
    """Train and evaluate in this process, and write the result."""
    lpips = None if job.lpips is None else Lpips.load(Path(job.lpips))
    compute = Compute(device, threads)
    options = TrainOptions(
        recipe=job.recipe,
        settings=job.settings,
        resolution=job.resolution,
        hold_out=job.hold_out,
        checkpoint_seconds=_CHECKPOINT_SECONDS,
        compute=compute,
    )
    output = Path(job.output)
    begin = time.monotonic()
    if TrainingFolder(output).is_training():
        trained_now = resume(output, options, dataset=job.dataset)
    else:
        trained_now = train(job.dataset, output, options)
    history = History.read(TrainingFolder(output).history, trained_now.step)  # of all runs
    seconds = time.monotonic() - begin + history.seconds - trained_now.seconds
    memory = peak_bytes()
    trained = load_trained(output, dataset=job.dataset, compute=compute)
    evaluation = evaluate(trained, lpips=lpips)
    worst = _write_worst(trained, evaluation, output / WORST)
    dataset, first = trained.dataset, trained.dataset.test[0].camera
    result = SceneResult(
        job,
        evaluation.psnr,
        evaluation.ssim,
        evaluation.lpips,
        len(trained.gaussians),
        seconds,
        memory,
        (len(dataset.train), len(dataset.test)),
        (first.width, first.height),
        worst,
        processor_name(),
    )
    write_json(job.result, asdict(result))


def _write_worst(trained: TrainedScene, evaluation: Evaluation, file: Path) -> str:
    """Write the picture `WORST`; returns the name of the view."""
    worst = min(evaluation.views, key=lambda view: view.psnr)
    [view] = [view for view in trained.dataset.test if view.name == worst.name]
    color = torch.tensor(trained.background, device=trained.gaussians.means.device)
    with ImageLoader([view], device=color.device) as loader:
        (drawn,) = renderings(trained.gaussians, [view], loader, color)
    pixels = [to_8bit(image) for image in (drawn.photo, drawn.image)]
    both = Image.fromarray(np.concatenate(pixels, axis=1))
    both.thumbnail((2 * _SIDE, _SIDE))
    with atomic_path(file) as temporary:
        both.save(temporary, "JPEG", quality=85)
    return worst.name


def _end_with_parent() -> None:
    """Stop when the process that called `run` has ended: then another one may take the scene."""
    sys.stdin.read()
    _thread.interrupt_main()


def main() -> int:
    """Returns the exit code."""
    request = json.loads(sys.stdin.readline())
    import_own_files()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    job = from_json(Job, request["job"])
    sys.argv = ["snowsplat", "benchmark", "-o", str(Path(job.output).parent)]  # for `Holder`
    try:
        with locked(Path(f"{job.output}.lock"), job.scene, _WAIT_SECONDS):
            if SceneResult.read(job) is None:
                with ended_by_signals():
                    work(job, request["device"], request["threads"])
    except InUse as error:
        print(error, file=sys.stderr)
        return TAKEN
    except UserError as error:
        print(f"snowsplat: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())


@dataclass(frozen=True)
class Figures:
    """Published figures; None: not published."""

    psnr: float
    ssim: float | None = None
    lpips: float | None = None


@dataclass(frozen=True)
class Suite:
    """A protocol."""

    title: str  # the name for readers
    protocol: str  # how photos are scaled and held out, in sentences
    # For each scene, the number by which the photos are divided. The official smaller photos (such
    # as images_4) are used if the dataset has them. Scenes that are not listed have their full
    # size.
    resolutions: dict[str, int] = field(default_factory=dict)
    # Settings of the training that the protocol fixes.
    settings: dict[str, Any] = field(default_factory=dict)
    published: dict[str, Figures] = field(default_factory=dict)  # figures of each scene
    source: str = ""  # the source of the published figures


#: The suites by name, from `suites.json`.
SUITES = {
    name: from_json(Suite, values)
    for name, values in read_json(Path(__file__).with_name("suites.json")).items()
}


def suite_of(scenes: Iterable[str]) -> str:
    """The name of the suite to which all scenes belong; "custom" if there is none."""
    names = set(scenes)
    for name, suite in SUITES.items():
        if names and names <= {*suite.published, *suite.resolutions}:
            return name
    return "custom"
