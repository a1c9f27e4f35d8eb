"""How a training run ends: `TrainResult` or, after Ctrl-C, `TrainingStopped`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from snowsplat.evaluation.metrics import Evaluation
from snowsplat.evaluation.verdict import Verdict
from snowsplat.project.left_out import LeftOut
from snowsplat.training.parts.part_report import PartReport
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
