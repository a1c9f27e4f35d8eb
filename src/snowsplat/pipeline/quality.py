"""`PRESETS`: the work of `make` at each quality, and the quality that a given time allows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Quality = Literal["draft", "normal", "best"]

# Estimates for a video before it is read: number of frames, and of matched pairs per frame.
_FRAMES_PER_VIDEO = 80
_PAIRS_PER_FRAME = 12
# The share of the given time that structure from motion may take.
_SHARE_OF_POSES = 0.4


@dataclass(frozen=True)
class Preset:
    """The settings and the time at one quality. Sizes are those of the longer side, in pixels.

    Attributes:
        photos: the size to which photos are reduced when they are copied into the dataset.
        side: the size of the photos in training.
        iterations: steps of the training.
        max_gaussians, densify_interval: settings of the training; None: those of the recipe.
        photo_seconds, pair_seconds: time of structure from motion on two cores, for each photo and
            for each pair of photos that is matched.
        pairs: the largest number of photos with which a photo is matched.
    """

    photos: int
    side: int
    iterations: int
    max_gaussians: int | None
    densify_interval: int | None
    photo_seconds: float
    pair_seconds: float
    pairs: int

    def pose_seconds(self, photos: int, videos: int, threads: int) -> float:
        """Estimated time of structure from motion for these numbers of photos and videos."""
        frames = _FRAMES_PER_VIDEO * videos
        matched = photos * min((photos - 1) / 2, self.pairs) + frames * _PAIRS_PER_FRAME
        seconds = self.photo_seconds * (photos + frames) + self.pair_seconds * matched
        return seconds * 2 / threads


PRESETS: dict[Quality, Preset] = {
    "draft": Preset(1600, 640, 1500, 60_000, 50, 0.25, 0.004, 20),
    "normal": Preset(2400, 1000, 3000, None, None, 0.6, 0.035, 35),
    "best": Preset(3200, 1600, 10_000, 250_000, None, 2.0, 0.15, 60),
}


def quality_within(seconds: float, photos: int, videos: int, threads: int) -> Quality:
    """The best quality for which enough of ``seconds`` is left for the training."""
    choices: tuple[Quality, ...] = ("best", "normal")
    for quality in choices:
        needed = PRESETS[quality].pose_seconds(photos, videos, threads)
        if needed <= _SHARE_OF_POSES * seconds:
            return quality
    return "draft"
