"""What `train` and `make` return: `TrainResult`, `TrainingStopped` after Ctrl-C, `MakeResult`."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from snowsplat.evaluation.metrics import Evaluation
from snowsplat.evaluation.verdict import Verdict
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.project.left_out import LeftOut
from snowsplat.project.project import Project
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.training.parts.part import PartReport
from snowsplat.util.messages import Message


@dataclass(frozen=True)
class TrainResult:
    """A finished training run.

    Attributes:
        scene: the PLY file.
        report: the HTML page about the training.
        step: the last step.
        first_step: the step of the checkpoint that was resumed, or 0.
        gaussians: their number.
        seconds: duration of the steps of this run.
        memory: the peak memory of the steps, as text.
        reductions: what was reduced because of the memory budget, as text.
        evaluation: the step and the metrics of the last evaluation on held-out photos.
        left_out: the training photos that were left out, because the scene does not explain
            them; see ``TrainConfig.leave_out_after``.
        parts: what the parts of the training report, by their names; for example, ``facts`` of
            "transients" is the share of each photo that is masked because something moves there.
        verdict: whether the scene is good, usable or poor, and why; None if no photos were held
            out.
        time: the seconds that were used, including earlier runs, and the time budget in seconds;
            None without a time budget.
    """

    scene: Path
    report: Path
    step: int
    first_step: int
    gaussians: int
    seconds: float
    memory: Message
    reductions: tuple[str, ...]
    evaluation: tuple[int, Evaluation] | None
    left_out: tuple[LeftOut, ...]
    parts: Mapping[str, PartReport]
    verdict: Verdict | None
    time: tuple[float, float] | None


class TrainingStopped(KeyboardInterrupt):
    """Ctrl-C during a training run.

    Attributes:
        scene: the scene file that was saved, together with a checkpoint; None if a second Ctrl-C
            interrupted a step: then only the older checkpoints remain.
    """

    def __init__(self, message: str, scene: Path | None) -> None:
        super().__init__(message)
        self.scene = scene


@dataclass(frozen=True)
class Figures:
    """What the training tells about a scene, before the last part: the result of a stage, as JSON.

    Attributes:
        iteration: the last step of the training.
        views: number of held-out photos.
        exposures: whether gains of exposure are learnt; then the colour-aligned PSNR tells the
            quality.
        verdict: the JSON value of the `Verdict`.
        psnr, ssim, psnr_aligned: means over the held-out photos; PSNR in dB. None if no photos were
            held out.
        size: of the images of which these are the means, in pixels, as text.
    """

    iteration: int
    views: int
    exposures: bool
    verdict: Any = None
    psnr: float | None = None
    ssim: float | None = None
    psnr_aligned: float | None = None
    size: str = "an unknown size"


@dataclass(frozen=True)
class LastPart:
    """What `train_on_all` has done. All fields can be stored as JSON."""

    steps: int = 0
    photos: int = 0  # their number
    left_out: int = 0  # the number of photos that the scene does not explain
    why_not: Message | None = None  # why there was no last part; None if there was one


@dataclass(frozen=True)
class MakeResult:
    """A finished scene.

    Attributes:
        project: the output folder.
        dataset: the folder of the dataset that the scene is trained from.
        figures: the quality of the scene on the held-out photos, before the last part.
        last_part: the training on all photos, after the evaluation.
        seconds: duration of the call.
    """

    project: Project
    dataset: DatasetFolder
    figures: Figures
    last_part: LastPart
    seconds: float

    @property
    def scene(self) -> Path:
        """The PLY file."""
        return self.project.scene_file()

    @property
    def training(self) -> TrainingFolder:
        return self.project.training_folder()

    @property
    def verdict(self) -> Verdict | None:
        """Whether the scene is good, usable or poor, and why; None if no photos were held out."""
        return Verdict.from_json(self.figures.verdict)

    @property
    def dataset_report(self) -> Path | None:
        """The HTML page about the camera poses; None if the input has poses."""
        return self.dataset.report if self.dataset == self.project.dataset else None

    @property
    def renders(self) -> Path:
        """The folder with the rendered test views."""
        return self.training.rendered("test", self.figures.iteration).renders

    @property
    def photos(self) -> Path:
        """The folder with the held-out photos."""
        return self.training.rendered("test", self.figures.iteration).photos

    def as_json(self) -> dict[str, Any]:
        """The values for scripts; paths are `Path`s."""
        figures = asdict(self.figures)
        for name in ("iteration", "verdict"):
            del figures[name]
        return {
            "scene": self.scene,
            "folder": self.training.path,
            "dataset": self.dataset.path,
            "dataset_report": self.dataset_report,
            "renders": self.renders,
            "photos": self.photos,
            "all_photos": self.last_part.photos,
            "left_out": self.last_part.left_out,
            **figures,
            "verdict": self.verdict,
            "seconds": self.seconds,
        }
