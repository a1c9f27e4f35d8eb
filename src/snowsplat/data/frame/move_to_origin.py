"""Moves a dataset that is far from 0, before its numbers become float32; see `scene.origin`."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from snowsplat.data.dataset import Points, PosedImage
from snowsplat.scene.origin import HERE, Origin, origin_of


def move_to_origin(
    posed: Sequence[PosedImage], points: Points | None
) -> tuple[list[PosedImage], Points | None, Origin]:
    """Cameras, points and the origin of a dataset as it is stored.

    The poses and points that are returned are relative to the origin. It is `HERE`, and nothing is
    moved, unless the scene is so far away that float32 would bend the scene.

    Args:
        posed: at least one, with poses in float64.
        points: may be in float64; the result is in float32.
    """
    centres = torch.stack([image.camera.position for image in posed]).numpy()
    # Both decide: points that were moved without the poses are the business of the judge.
    known = centres if points is None else np.concatenate([centres, points.xyz.double().numpy()])
    origin = origin_of(known)
    if origin == HERE:
        return list(posed), _float32(points), origin
    moved = [replace(image, camera=image.camera.seen_from(origin)) for image in posed]
    if points is not None:
        xyz = points.xyz.double() - torch.tensor(origin, dtype=torch.float64)
        points = replace(points, xyz=xyz)
    return moved, _float32(points), origin


def _float32(points: Points | None) -> Points | None:
    return None if points is None else replace(points, xyz=points.xyz.float().contiguous())
