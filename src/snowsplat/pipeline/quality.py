"""`PRESETS`: the work of `make` at each quality."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Quality = Literal["draft", "normal", "best"]


@dataclass(frozen=True)
class Preset:
    """The settings at one quality. A size is the length of the longer side, in pixels."""

    photos: int  # the size to which photos are reduced when they are copied into the dataset
    side: int  # the size of the photos in training
    iterations: int  # steps of the training
    # max_gaussians, densify_interval: settings of the training; None: the value of the recipe.
    max_gaussians: int | None
    densify_interval: int | None
    # About the time of the training and of the test views, in seconds of one core of the reference
    # machine of `sfm.cost`.
    training: float


PRESETS: dict[Quality, Preset] = {
    "draft": Preset(1600, 640, 1500, 60_000, 50, 120.0),
    "normal": Preset(2400, 1000, 2000, None, None, 500.0),
    "best": Preset(3200, 1600, 10_000, 250_000, None, 4000.0),
}
