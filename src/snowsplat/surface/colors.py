"""Colours of the vertices of a mesh from photos."""

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.surface.depth import DepthMap
from snowsplat.surface.volume import to_image

_GREY = 128
_ROUNDS = 64  # from neighbour to neighbour, for vertices that no photo shows


def vertex_colors(
    vertices: np.ndarray,
    faces: np.ndarray,
    views: Iterable[tuple[DepthMap, Tensor, Tensor | None]],
    tolerance: float,
) -> np.ndarray:
    """(V, 3) uint8: the mean colour of each vertex in the photos that show it.

    A photo counts with the confidence of its depth map and the square of the resolution with which
    it shows the vertex. Vertices that no photo shows have the colour of their neighbours.

    Args:
        vertices: (V, 3) float32, world frame.
        faces: (F, 3) int32.
        views: depth map, photo (3, H, W) uint8 sRGB, and usable pixels (H, W) bool or None.
        tolerance: a photo shows a vertex whose depth differs by less, world units.
    """
    points = torch.from_numpy(vertices)
    sums = torch.zeros(len(points), 1, 1, 1, 5)
    for each, photo, usable in views:
        device = each.depth.device
        points, sums = points.to(device), sums.to(device)
        weight = each.confidence * (each.camera.fx / each.depth.clamp_min(1e-30)) ** 2
        if usable is not None:
            weight = weight * usable.to(device)
        ops.fuse_depth(
            sums,
            points,
            0.0,
            to_image(each.camera, sums),
            each.depth,
            weight,
            tolerance,
            photo.to(device, torch.float32),
        )
    totals = sums[:, 0, 0, 0].cpu().numpy()
    return _spread(totals[:, 2:], totals[:, 0], faces)


def _spread(colors: np.ndarray, weight: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) uint8: colours divided by their weight; neighbours' where it is 0."""
    known = weight > 0
    colors = np.where(known[:, None], colors / np.where(known, weight, 1)[:, None], 0)
    faces = faces[~known[faces].all(1)]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.concatenate([edges, edges[:, ::-1]])
    for _ in range(_ROUNDS):
        border = edges[~known[edges[:, 0]] & known[edges[:, 1]]]
        if not len(border):
            break
        count = np.bincount(border[:, 0], minlength=len(known))
        for c in range(3):
            total = np.bincount(border[:, 0], colors[border[:, 1], c], len(known))
            colors[count > 0, c] = (total / np.maximum(count, 1))[count > 0]
        known |= count > 0
    return np.where(known[:, None], np.rint(colors), _GREY).clip(0, 255).astype(np.uint8)
