"""What structure from motion may be told, what it tells, and what an effort means in figures."""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from typing import Any, Literal

Mapper = Literal["incremental", "global"]
EffortName = Literal["draft", "normal", "best"]

# Those of COLMAP's that can be undistorted to a pinhole camera.
CAMERA_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "FOV",
    "OPENCV_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
)


@dataclass(frozen=True)
class SfmOptions:
    """How poses are found."""

    # One of `CAMERA_MODELS`, or "auto": OPENCV where enough photos share a camera to fix its eight
    # numbers, else SIMPLE_RADIAL.
    camera_model: str = "auto"
    mapper: Mapper = "incremental"
    effort: EffortName = "normal"
    threads: int | None = None  # None: one a processor


@dataclass(frozen=True)
class SfmResult:
    """Poses are in ``distorted/sparse/0``; this says how good they are. All of it fits JSON."""

    registered: list[str]  # names of photos, sorted
    unregistered: dict[str, str]  # name -> why, in words for people
    points: int
    observations: int
    reprojection_error: float  # pixels of the photos in input/, mean over points
    sub_models: list[int]  # photos of each, largest first
    cameras: list[dict[str, Any]]  # model, width, height, params, focal_from, images
    pairs: str  # how pairs of photos were chosen
    attempts: list[str]  # what was tried, in order


@dataclass(frozen=True)
class Effort:
    """The figures behind a word: what is looked for in a photo, and how many pairs are compared."""

    image_size: int  # pixels of the longest side at which features are looked for
    features: int  # about so many a photo
    first_octave: int  # -1: also in the photo enlarged twice, where the small, exact ones are
    exhaustive: int  # up to so many photos, each is compared with each
    overlap: int  # a frame of a video is compared with so many next ones
    neighbours: int  # a photo among many is compared with so many that look alike

    def stronger(self) -> Effort:
        """More of everything, for photos that would not hold together: about 4 times the work."""
        return dataclasses.replace(
            self,
            image_size=self.image_size * 3 // 2,
            features=self.features * 2,
            first_octave=-1,
            exhaustive=self.exhaustive * 3 // 2,
            overlap=self.overlap * 2,
            neighbours=self.neighbours * 2,
        )

    def gentler(self) -> Effort:
        """A third of the memory, after a crash."""
        return dataclasses.replace(
            self,
            image_size=self.image_size * 2 // 3,
            features=self.features // 2,
            first_octave=0,
        )


EFFORTS: dict[EffortName, Effort] = {
    "draft": Effort(1000, 2048, 0, exhaustive=40, overlap=6, neighbours=15),
    "normal": Effort(1600, 4096, -1, exhaustive=70, overlap=10, neighbours=25),
    "best": Effort(2400, 8192, -1, exhaustive=120, overlap=15, neighbours=40),
}


def thread_count(threads: int | None) -> int:
    """Threads to use: as asked, or one a processor that this process may use."""
    if threads is not None:
        return max(1, threads)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
