"""The result of structure from motion, and the parameters of each effort level."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from snowsplat.data.lens.models import COLMAP_MODELS
from snowsplat.sfm.options import EffortName
from snowsplat.util.machine import processor_count
from snowsplat.util.messages import Message

# The camera models of COLMAP that can be undistorted to pinhole cameras.
_NOT_UNDISTORTED = ("SIMPLE_DIVISION", "DIVISION", "EUCM")
CAMERA_MODELS = tuple(m.name for m in COLMAP_MODELS if m.name not in _NOT_UNDISTORTED)
#: The camera model of 360° panoramas, twice as wide as high.
PANORAMA_MODEL = "EQUIRECTANGULAR"


@dataclass(frozen=True)
class SfmResult:
    """The quality of the poses in ``distorted/sparse/0``. All fields can be stored as JSON."""

    registered: list[str]  # names of photos with a pose, sorted
    unregistered: dict[str, Message]  # name -> the reason
    points: int
    observations: int
    # Pixels of the photos in input/, mean over the points that at least three photos see.
    reprojection_error: float
    sub_models: list[int]  # number of photos of each model, largest first
    # For each camera: model, width, height, params, focal_from ("exif" or "guessed"), focal_held
    # (whether the focal length was not refined), and images, the number of photos.
    cameras: list[dict[str, Any]]
    pairs: str  # how the pairs of photos to match were chosen, as text for users
    attempts: list[str]  # a description of each attempt, as text for users, in order
    # What is in doubt about the poses and lenses; earlier versions did not have this.
    doubts: list[Message] = field(default_factory=list)
    # The focal lengths, as text for users, if those of photos of one group differ (`Photo.group`).
    zooms: str = ""
    # How well the poses agree with the matches where they agree least: 0 to 1
    # (`consistency.agreement_of`).
    agreement: float = 1.0
    # Which photos are from a fisheye lens, as text for users, if this was found from their matches.
    fisheye: str = ""


@dataclass(frozen=True)
class Effort:
    """The parameters of an effort level: features per photo and pairs to match."""

    image_size: int  # longest side in pixels; larger photos are resized before feature detection
    features: int  # approximate number per photo
    exhaustive: int  # up to this number of photos, all pairs are matched
    overlap: int  # number of following frames with which a frame of a video is matched
    neighbours: int  # number of similar or near photos with which a photo is matched

    def stronger(self) -> Effort:
        """An effort with more features and pairs, for a further attempt; about 4 times the work."""
        return dataclasses.replace(
            self,
            image_size=self.image_size * 3 // 2,
            features=self.features * 2,
            exhaustive=self.exhaustive * 3 // 2,
            overlap=self.overlap * 2,
            neighbours=self.neighbours * 2,
        )

    def reduced(self) -> Effort:
        """An effort that needs about a third of the memory, to repeat a run after a crash."""
        return dataclasses.replace(
            self, image_size=self.image_size * 2 // 3, features=self.features // 2
        )


# Features of a panorama, and its width for their detection, divided by those of a photo. A panorama
# has about five times the field of view.
_PANORAMA_FEATURES, _PANORAMA_SIZE = 2, 2.5


def detection_size(image_size: int, panorama: bool) -> int:
    """The longest side, in pixels, at which features are detected; larger photos are resized."""
    return round(_PANORAMA_SIZE * image_size) if panorama else image_size


def feature_count(features: int, panorama: bool) -> int:
    """The approximate number of features of a photo."""
    return _PANORAMA_FEATURES * features if panorama else features


EFFORTS: dict[EffortName, Effort] = {
    "draft": Effort(1000, 2048, exhaustive=40, overlap=6, neighbours=15),
    "normal": Effort(1600, 5120, exhaustive=70, overlap=10, neighbours=25),
    "best": Effort(2400, 10240, exhaustive=120, overlap=15, neighbours=40),
}

_MANY_PHOTOS = 100
_SUBSET = 0.4


def photos_with_adjustment(count: int) -> int:
    """How many of ``count`` photos are registered with bundle adjustment, before the others.

    Without bundle adjustment, a photo takes about a third of the time.
    """
    return min(count, max(_MANY_PHOTOS, round(_SUBSET * count)))


def thread_count(threads: int | None) -> int:
    """Number of threads: ``threads``, or the number of processors that this process may use."""
    return processor_count() if threads is None else max(1, threads)
