"""A dataset: posed images, split into training and test, and the points to start from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from snowsplat.data.bounds import scene_bounds
from snowsplat.data.decode import ImageSource
from snowsplat.scene.camera import Camera
from snowsplat.util.errors import UserError


@dataclass
class Points:
    """A coloured point cloud in the world frame."""

    xyz: Tensor  # (P, 3) float32, finite
    rgb: Tensor  # (P, 3) uint8

    def __len__(self) -> int:
        return self.xyz.shape[0]

    def to(self, device: torch.device) -> Points:
        """On another device; no copy where they are there already."""
        return Points(self.xyz.to(device), self.rgb.to(device))


@dataclass(frozen=True, eq=False)
class View:
    """One posed image. ``camera`` has the size that ``image`` has when decoded."""

    name: str  # unique in its dataset; relative, with '/', and without '..': fit to name a file
    camera: Camera
    image: ImageSource
    mask: ImageSource | None = None  # where it is black, the image does not count


@dataclass
class Dataset:
    """What training needs; always posed, all of it finite.

    ``train`` and ``test`` are in the order of their names. ``points`` is None where the dataset
    came without: then `bounds` says where to begin.

    Raises:
        UserError: cameras or points that are not finite.
    """

    train: list[View]
    test: list[View]
    points: Points | None
    extent: float  # world units: 1.1 × the largest distance of a training camera from their mean
    description: str = ""  # which files it was read from, for people

    def __post_init__(self) -> None:
        of = f"{self.description}: " if self.description else ""
        views = [*self.train, *self.test]
        bad = [view.name for view in views if not view.camera.is_finite()]
        if bad:
            raise UserError(
                f"{of}{len(bad)} of {len(views)} cameras are not finite, that of {bad[0]} first; "
                "correct their poses or leave these photos out"
            )
        if not 0.0 < self.extent < math.inf:
            raise UserError(f"{of}the extent of its cameras is {self.extent}; correct them")
        if self.points is not None:
            rows = int((~self.points.xyz.isfinite().all(dim=1)).sum())
            if rows:
                raise UserError(
                    f"{of}{rows:,} of {len(self.points):,} points are not finite; remove them"
                )

    @property
    def bounds(self) -> Tensor:
        """(2, 3) float32: low and high corner of a box around the scene; see `scene_bounds`."""
        points = None if self.points is None else self.points.xyz
        return scene_bounds([view.camera for view in self.train or self.test], points)


@dataclass(frozen=True, eq=False)
class PosedImage:
    """What a reader found: an image file, and its camera at the size it was made for."""

    name: str  # as `View.name`
    camera: Camera
    folder: (
        Path  # the folder of images; beside it are those of smaller copies: images_2, images_4 …
    )
    file: str  # relative to ``folder``; the file is there
    mask: Path | None = None
    split: Literal["train", "test"] | None = None  # what the dataset's own files say
    divided: int = 1  # by how much the files here are smaller because -r asked for such copies

    @property
    def path(self) -> Path:
        return self.folder / self.file


def safe_name(path: str) -> str:
    """A path as a dataset names its image, made fit for `View.name`."""
    parts = path.replace("\\", "/").split("/")
    return "/".join(part for part in parts if part not in ("", ".", "..") and ":" not in part)


def scene_extent(cameras: list[Camera]) -> float:
    """1.1 × the largest distance of a camera centre from their mean (the paper's scene extent).

    It scales the learning rate of positions, so it must not be 0: cameras that all stand in one
    place give 1.
    """
    centres = torch.stack([camera.position.detach() for camera in cameras])
    radius = float((centres - centres.mean(0)).norm(dim=1).max())
    return 1.1 * radius if radius > 0.0 else 1.0
