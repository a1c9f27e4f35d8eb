"""The types of a dataset: posed images, split into training and test, and 3D points."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from snowsplat.data.frame.bounds import scene_bounds
from snowsplat.data.lens.lens import Lens
from snowsplat.data.photos.decode import ImageSource
from snowsplat.scene.camera import Camera
from snowsplat.scene.origin import HERE, Origin
from snowsplat.util.errors import UserError
from snowsplat.util.messages import Message

logger = logging.getLogger(__name__)

# Largest coordinate of a point, in world units. Squared distances must be finite in float32.
_MAX_COORDINATE = 1e18


@dataclass(frozen=True)
class Tracks:
    """Where photos show some of the points, as measured by the program that made the points.

    Attributes:
        photos: names of photos, as `View.name`; of distorted ones too.
        photo: (N,) int64, index of the photo of each observation.
        point: (N,) int64, index of the point.
        ray: (N, 2) float64, x / z and y / z in the frame of the camera.
    """

    photos: list[str]
    photo: np.ndarray
    point: np.ndarray
    ray: np.ndarray


@dataclass
class Points:
    """A coloured point cloud in the world frame."""

    xyz: Tensor  # (P, 3) float32, finite; readers return float64 if the file has it
    rgb: Tensor  # (P, 3) uint8
    tracks: Tracks | None = None  # of some of the points

    def __len__(self) -> int:
        return self.xyz.shape[0]

    def to(self, device: torch.device) -> Points:
        """These points on ``device``; not copied if they are already there."""
        return Points(self.xyz.to(device), self.rgb.to(device), self.tracks)


def usable_points(path: Path, xyz: np.ndarray, rgb: np.ndarray) -> Points | None:
    """The points whose coordinates are finite and below 1e18; None if there are none.

    Logs a warning with the number of points that are left out.

    Args:
        path: the file that the points were read from, for the warning.
        xyz: (P, 3) positions in the world frame, of any float dtype.
        rgb: (P, 3) colours in 0..255.
    """
    usable = (np.abs(xyz) < _MAX_COORDINATE).all(axis=1)
    if not usable.all():
        count = (~usable).sum()
        logger.warning("%s: skipped %d points that are not finite or too far away", path, count)
        xyz, rgb = xyz[usable], rgb[usable]
    if not len(xyz):
        return None
    # A single row of a table is contiguous for NumPy, and not for torch: it is copied, too.
    return Points(torch.from_numpy(np.array(xyz)), torch.from_numpy(np.array(rgb, np.uint8)))


@dataclass(frozen=True, eq=False)
class View:
    """One posed image. ``camera`` has the size of the decoded ``image``."""

    name: str  # unique in its dataset; a relative path with '/' and without '..'
    camera: Camera
    image: ImageSource
    mask: ImageSource | None = None  # black pixels of the mask are ignored in the image
    depth: Path | None = None  # a depth map of the image, of any size; see `read_depth_file`
    depth_unit: float = 1.0  # world units per unit of the depth map, if the dataset has no points
    depth_confidence: Path | None = None  # a map of the same size; 0: the depth is not used
    normals: Path | None = None  # a normal map of the image, of any size; see `read_normal_file`

    @property
    def photo(self) -> str:
        """The name of the photo; it may have several views."""
        part = self.image.view
        return self.name.removesuffix(f"/{part.name}") if part and part.name else self.name


@dataclass
class Dataset:
    """Posed images and points for training. Cameras and points are finite.

    Raises:
        UserError: a camera or a point is not finite.
    """

    train: list[View]  # sorted by name
    test: list[View]  # sorted by name
    points: Points | None  # None: the dataset has no points; `bounds` is estimated from cameras
    extent: float  # world units; see `scene_extent`
    description: str | Message = ""  # the files it was read from, for messages
    origin: Origin = HERE  # of cameras and points, in the world frame of the files
    metres_per_unit: float | None = None  # true length of a world unit; None: unknown

    def __post_init__(self) -> None:
        prefix = f"{self.description}: " if self.description else ""
        views = [*self.train, *self.test]
        bad = [view.name for view in views if not view.camera.is_finite()]
        if bad:
            raise UserError(
                "{prefix}{bad} of {views} cameras are not finite (the first is that of {bad2}); "
                "correct their poses or remove these photos",
                prefix=prefix,
                bad=len(bad),
                views=len(views),
                bad2=bad[0],
            )
        if not 0.0 < self.extent < math.inf:
            raise UserError(
                "{prefix}the extent of the cameras is {extent}; correct their poses",
                prefix=prefix,
                extent=self.extent,
            )
        if self.points is not None:
            rows = int((~self.points.xyz.isfinite().all(dim=1)).sum())
            if rows:
                raise UserError(
                    "{prefix}{rows:,} of {points:,} points are not finite; remove them",
                    prefix=prefix,
                    rows=rows,
                    points=len(self.points),
                )

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float32: lower and upper corner of a box around the scene; see `scene_bounds`."""
        points = None if self.points is None else self.points.xyz
        return scene_bounds([view.camera for view in self.train or self.test], points)


@dataclass(frozen=True, eq=False)
class PosedImage:
    """What a reader returns: an existing image file and its camera.

    The camera has the image size that the pose was estimated with; the file may be smaller.
    """

    name: str  # as `View.name`
    camera: Camera  # if the photo is distorted, only its size and pose are used
    lens: Lens
    folder: Path  # of images; smaller copies may be in the sibling folders images_2, images_4 …
    file: str  # relative to ``folder``
    mask: Path | None = None
    split: Literal["train", "test"] | None = None  # from the dataset's own files
    divided: int = 1  # 2, 4 or 8 if ``folder`` is images_2, images_4 or images_8
    depth: Path | None = None  # as `View.depth`
    depth_unit: float = 1.0  # as `View.depth_unit`
    depth_confidence: Path | None = None  # as `View.depth_confidence`
    normals: Path | None = None  # as `View.normals`
    frame: str | None = None  # images of one frame of a rig, taken at one time, share this name

    @classmethod
    def below(cls, root: Path, file: str, camera: Camera, lens: Lens) -> PosedImage:
        """The image ``file``, a path relative to ``root``, the folder of the dataset."""
        first, slash, _ = file.partition("/")
        folder = root / first if slash else root
        rest = (root / file).relative_to(folder).as_posix()
        return cls(safe_name(file), camera, lens, folder, rest)

    @property
    def path(self) -> Path:
        """The image file."""
        return self.folder / self.file


def safe_name(path: str) -> str:
    """A valid `View.name` from the path of an image as written in a dataset file."""
    parts = path.replace("\\", "/").split("/")
    return "/".join(part for part in parts if part not in ("", ".", "..") and ":" not in part)
