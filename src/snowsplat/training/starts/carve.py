"""`carved_points`: space carving (Kutulakos and Seitz 2000)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.image_loader import Photos
from snowsplat.scene.camera import Camera
from snowsplat.training.starts.photos import reduced_photo, usable_pixels

#: Number of voxels along the longest side of the box.
_SIDE = 96
#: The maximum number of views, chosen at equal distances in their order.
_VIEWS = 24
#: Views are reduced so that a voxel in the middle of the box is this number of pixels wide. Then
#: the voxels of a surface cover all of its pixels.
_PIXELS = 0.7
#: A voxel is removed if the standard deviation of its colour over the views is larger, in 0..1.
_SPREAD = 0.12
#: A voxel is in front of another one if it is nearer by more than this number of voxels.
_NEARER = 1.8
#: Carving ends when a round removes less than this share of the surface, at the latest after this
#: number of rounds.
_LEAST_REMOVED, _ROUNDS = 0.002, 2 * _SIDE


def carved_points(
    dataset: Dataset, images: Photos, count: int, generator: torch.Generator
) -> Points:
    """At most ``count`` points on the surface of the photo hull, in the world frame.

    The box `Dataset.bounds` is filled with voxels. From the surface inwards, voxels are removed
    which a view shows as transparent, or whose colour is not the same in all views in which no
    other voxel covers them. What remains is the photo hull: the largest shape that is consistent
    with the photos. The method needs a scene inside the box, and diffuse surfaces with texture.

    Args:
        generator: a random generator on the CPU.
    """
    low, high = dataset.bounds.to(torch.float64)
    size = float((high - low).max()) / _SIDE
    shape = ((high - low) / size).ceil().to(torch.int64).clamp(min=1).tolist()
    views = dataset.train[:: math.ceil(len(dataset.train) / _VIEWS)]
    pictures = [_Picture.from_view(view, images, 0.5 * (low + high), size) for view in views]
    solid = torch.ones(shape, dtype=torch.bool)
    for _ in range(_ROUNDS):
        cells = _surface(solid).nonzero()
        points = low + (cells + 0.5) * size
        keep, colors = _consistent(points, pictures, size)
        solid[tuple(cells[~keep].unbind(1))] = False
        if float((~keep).sum()) <= _LEAST_REMOVED * len(keep):
            break
    seen = keep & ~colors.isnan().any(1)
    chosen = seen.nonzero()[:, 0]
    chosen = chosen[torch.randperm(len(chosen), generator=generator)[:count]]
    rgb = (255.0 * colors[chosen]).round().to(torch.uint8)
    return Points(points[chosen].to(torch.float32), rgb)


@dataclass(frozen=True)
class _Picture:
    """A reduced photo; ``camera`` has its size."""

    camera: Camera
    rgb: Tensor  # (H, W, 3) float32 in 0..1
    usable: Tensor | None  # (H, W) bool: False for masked and transparent pixels
    transparent: Tensor | None  # (H, W) bool

    @staticmethod
    def from_view(view: View, images: Photos, middle: Tensor, size: float) -> _Picture:
        camera = view.camera
        distance = max(float((camera.position.to(torch.float64) - middle).norm()), size)
        scale = min(1.0, _PIXELS * distance / (size * camera.fx))
        width, height = (max(1, round(scale * side)) for side in (camera.width, camera.height))
        photo = reduced_photo(view, images, width, height)
        transparent = None if photo.alpha is None else photo.alpha < 128
        rgb = photo.rgb.to(torch.float32) / 255.0
        return _Picture(camera.scaled(width, height), rgb, usable_pixels(photo), transparent)


def _surface(solid: Tensor) -> Tensor:
    """(X, Y, Z) bool: the voxels with an empty neighbour or at the border of the box."""
    empty = torch.nn.functional.pad((~solid).to(torch.float32), (1,) * 6, value=1.0)[None]
    return solid & (max_pool3d(empty, 3, stride=1)[0] > 0.0)


def _consistent(points: Tensor, pictures: list[_Picture], size: float) -> tuple[Tensor, Tensor]:
    """For the voxels of the surface, (P, 3): whether to keep each, (P,) bool, and its mean colour,
    (P, 3) in 0..1; NaN if fewer than two views show it.
    """
    number = torch.zeros(len(points))
    total, squares = torch.zeros(len(points), 3), torch.zeros(len(points), 3)
    keep = torch.ones(len(points), dtype=torch.bool)
    for picture in pictures:
        rows, index = _visible(points, picture.camera, size)
        if picture.transparent is not None:
            keep[rows[picture.transparent.flatten()[index]]] = False
        if picture.usable is not None:
            usable = picture.usable.flatten()[index]
            rows, index = rows[usable], index[usable]
        color = picture.rgb.reshape(-1, 3)[index]
        number[rows] += 1.0
        total[rows] += color
        squares[rows] += color.square()
    mean = total / number[:, None]
    variance = (squares / number[:, None] - mean.square()).clamp(min=0.0).mean(1)
    keep &= ~((number >= 2) & (variance.sqrt() > _SPREAD))
    mean[number < 2] = torch.nan
    return keep, mean


def _visible(points: Tensor, camera: Camera, size: float) -> tuple[Tensor, Tensor]:
    """The points that a view shows: their rows (V,) and the indices of their pixels (V,)."""
    pixel, depth = camera.project(points)
    inside = (depth > size) & (pixel >= 0).all(1)
    inside &= (pixel[:, 0] < camera.width) & (pixel[:, 1] < camera.height)
    rows = inside.nonzero()[:, 0]
    x, y = pixel[rows].to(torch.int64).unbind(1)
    index, depth = y * camera.width + x, depth[rows]
    nearest = torch.full((camera.width * camera.height,), math.inf, dtype=depth.dtype)
    nearest.scatter_reduce_(0, index, depth, "amin")
    visible = depth <= nearest[index] + _NEARER * size
    return rows[visible], index[visible]
