"""What `snowsplat make` does at each quality, and which effort a time allows for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Quality = Literal["draft", "normal", "best"]

# Frames that a video counts for, before it has been looked at; a frame is compared with few others.
_FRAMES_OF_A_VIDEO, _PAIRS_OF_A_FRAME = 80, 12
# The part of a time that finding the cameras may take.
_SHARE_OF_CAMERAS = 0.4


@dataclass(frozen=True)
class Preset:
    """How much work a quality is. Sizes are those of the longer side, in pixels.

    Attributes:
        photos: size to which photos are reduced when they are read.
        side: size at which they are trained on.
        iterations: steps of the training.
        max_gaussians, densify_interval: its cap, and the steps between two densifications; None
            is that of the recipe.
        photo_seconds, pair_seconds: to find the cameras, on two cores: what each photo takes, and
            each pair of photos that is compared.
        pairs: with how many others a photo is compared, at most.
    """

    photos: int
    side: int
    iterations: int
    max_gaussians: int | None
    densify_interval: int | None
    photo_seconds: float
    pair_seconds: float
    pairs: int

    def camera_seconds(self, photos: int, videos: int, threads: int) -> float:
        """About how long it takes to find the cameras of so many photos and videos."""
        frames = _FRAMES_OF_A_VIDEO * videos
        compared = photos * min((photos - 1) / 2, self.pairs) + frames * _PAIRS_OF_A_FRAME
        seconds = self.photo_seconds * (photos + frames) + self.pair_seconds * compared
        return seconds * 2 / threads


PRESETS: dict[Quality, Preset] = {
    "draft": Preset(1600, 640, 1500, 60_000, 50, 0.25, 0.004, 20),
    "normal": Preset(2400, 1000, 3000, None, None, 0.6, 0.035, 35),
    "best": Preset(3200, 1600, 10_000, 250_000, None, 2.0, 0.15, 60),
}


def quality_within(seconds: float, photos: int, videos: int, threads: int) -> Quality:
    """The best effort to find the cameras that leaves enough of the time for the training."""
    choices: tuple[Quality, ...] = ("best", "normal")
    for quality in choices:
        needed = PRESETS[quality].camera_seconds(photos, videos, threads)
        if needed <= _SHARE_OF_CAMERAS * seconds:
            return quality
    return "draft"
