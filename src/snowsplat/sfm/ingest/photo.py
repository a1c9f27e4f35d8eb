"""One photo of those that become a dataset."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Photo:
    """A photo as it lies in ``input/``, upright, and what is known of it. All of it fits JSON."""

    name: str  # file in input/, relative, "/"; unique
    source: str  # where it came from: a path, or "walk.mp4 at 3.2 s"
    width: int  # pixels, as stored in input/
    height: int
    group: str  # photos of one group were taken by one camera with one zoom: they share intrinsics
    sequence: str | None  # the video that it is a frame of (name order is time), None for photos
    focal: float | None  # pixels, from EXIF; None if unknown
    location: tuple[float, float, float] | None  # GPS: latitude, longitude (degrees), altitude (m)
    mask: bool  # distorted/masks/NAME.png was written
    alpha: bool  # has transparency
