"""What a reader of this folder returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from snowsplat.data.dataset import Points
from snowsplat.data.imports.photos import PhotoFolder
from snowsplat.data.lens.model import LensModel


@dataclass(frozen=True, eq=False)
class Shot:
    """A photo with a pose."""

    photo: str  # relative to the root of the `PhotoFolder`
    lens: LensModel
    cam_from_world: np.ndarray  # (3, 4) float64, OpenCV axes
    depth: Path | None = None
    depth_unit: float = 1.0  # as `PosedImage.depth_unit`
    depth_confidence: Path | None = None  # as `PosedImage.depth_confidence`


@dataclass(eq=False)
class Reconstruction:
    """The photos and points of a file; readers add to it while they read.

    Attributes:
        total: number of photos in the file, with and without poses.
        missing: names of photos with poses that are not on disk.
        points_from: the file of the points, if it is another one.
    """

    shots: list[Shot] = field(default_factory=list)
    total: int = 0
    missing: list[str] = field(default_factory=list)
    points: Points | None = None
    points_from: str = ""

    def photo(self, photos: PhotoFolder, name: str) -> str | None:
        """The result of `PhotoFolder.find`; a photo that is not there is added to ``missing``."""
        photo = photos.find(name)
        if photo is None:
            self.missing.append(name)
        return photo
