"""`stage`: what a part needs of a training run, without a dataset on disk."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from snowsplat.data.dataset import Points
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.settings.schedule import Schedule


def stage(
    gaussians: Gaussians | None = None,
    step: int = 0,
    *,
    iterations: int = 1000,
    cameras: Sequence[Camera] = (),
    points: Tensor | None = None,
    views: int = 1,
    **others: Any,
) -> Any:
    """A run after ``step`` steps.

    Args:
        views: number of training views.
        others: further attributes of `Run`.
    """
    colored = (
        None if points is None else Points(points, torch.zeros(len(points), 3, dtype=torch.uint8))
    )
    usual = {
        "dataset": SimpleNamespace(train=[None] * views, points=colored),
        "device": torch.device("cpu"),
        "initial": None,
        "resumed": False,
        "excluded": (),
        "sh_degree": 0,
        "render": None,
        "note": lambda line: None,
        "background": SimpleNamespace(evaluation=torch.zeros(3), fixed=(0.0, 0.0, 0.0)),
    }
    return SimpleNamespace(
        gaussians=gaussians,
        step=step,
        schedule=Schedule(iterations),
        dataset_cameras=cameras,
        **usual | others,
    )
