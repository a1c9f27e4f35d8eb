"""`Progress`: what a training reports after each step."""

from __future__ import annotations

from dataclasses import dataclass

from snowsplat.evaluation.metrics import Evaluation


@dataclass(frozen=True)
class Progress:
    """The report of `Trainer.run` after each step.

    ``downscale`` is the factor by which the photos of the step were reduced. ``metrics`` is the
    evaluation of the test views, after the steps of ``test_iterations``; None after other steps.
    ``seconds_left`` is an estimate that `pipeline.run.training_run` adds.
    """

    step: int
    loss: float
    gaussians: int
    iterations: int
    downscale: int
    metrics: Evaluation | None = None
    seconds_left: float | None = None
