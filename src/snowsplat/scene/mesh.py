"""`Mesh`: triangles with coloured vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from snowsplat.scene.origin import HERE, Origin
from snowsplat.util.components import components


@dataclass(frozen=True)
class Mesh:
    """Triangles in the world frame, counter-clockwise as seen from outside.

    Attributes:
        vertices: (V, 3) float32, relative to ``origin``, world units.
        faces: (F, 3) int32, rows of ``vertices``; (0, 3) for a cloud of points.
        normals: (V, 3) float32, of length 1, outward; 0 where unknown.
        colors: (V, 3) uint8 sRGB.
        up: the direction upwards, of length 1.
        metres_per_unit: the true scale; None: unknown.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    origin: Origin = HERE
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)
    metres_per_unit: float | None = None


def y_up(up: tuple[float, float, float]) -> np.ndarray:
    """(3, 3) float64: the rotation after which ``up`` is +y; for −y, by 180° about x.

    It is the smallest rotation after that by 180° about x.
    """
    flip = np.diag([1.0, -1.0, -1.0])
    x, y, z = flip @ np.array(up)
    if y < -1 + 1e-9:  # straight down: there is no smallest rotation
        return np.diag([1.0, 1.0, 1.0])
    turn = np.array([[0, -x, 0], [x, 0, z], [0, -z, 0]])  # the cross product with up × y
    return np.asarray((np.eye(3) + turn + turn @ turn / (1 + y)) @ flip)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) float32: the sum of the normals of the triangles, weighted by area, of length 1."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(across[:, axis], 3), len(vertices))
            for axis in range(3)
        ],
        1,
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return (total / np.where(length > 0, length, 1)).astype(np.float32)


def compact_mesh(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices that a triangle uses, the triangles with new numbers, and the kept (V,) bool."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    return vertices[used], number[faces], used


def largest_parts(faces: np.ndarray, count: int, share: float) -> np.ndarray:
    """(F,) bool: the triangles of connected parts with at least ``share`` of the largest part's.

    ``faces``: (F, 3) rows of ``count`` vertices.
    """
    label = components(faces.T, count)[faces[:, 0]]
    size = np.bincount(label, minlength=count)[label]
    return np.asarray(size >= share * size.max(initial=0))


def filled_holes(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with a fan of triangles over each hole; the middle of its border is a new vertex.

    A border is a closed walk along the edges of a single triangle. The longest border of a mesh
    that is not closed is kept open if it is that of a surface, as of a façade: a hole has at most
    half of the length of the longest border, unless there is only one.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    count = len(vertices)
    single = np.isin(
        edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0], invert=True
    )
    following: dict[int, list[int]] = {}
    for a, b in edges[single].tolist():
        following.setdefault(a, []).append(b)
    loops: list[np.ndarray] = []
    while following:
        start = next(iter(following))
        loop = [start]
        while loop[-1] in following:
            ends = following[loop[-1]]
            loop.append(ends.pop())
            if not ends:
                del following[loop[-2]]
            if loop[-1] == start:
                loops.append(np.array(loop[:-1]))
                break
    lengths = [_length(vertices[loop]) for loop in loops]
    limit = 0.5 * max(lengths, default=0.0) if len(loops) > 1 else np.inf
    middles: list[np.ndarray] = []
    fans: list[np.ndarray] = []
    for border, length in zip(loops, lengths, strict=True):
        if length > limit:
            continue
        middle = np.full(len(border), count + len(middles))
        middles.append(vertices[border].mean(0))
        fans.append(np.stack([np.roll(border, -1), border, middle], 1))
    if not fans:
        return vertices, faces
    return (
        np.concatenate([vertices, np.array(middles, vertices.dtype)]),
        np.concatenate([faces, *fans]).astype(faces.dtype),
    )


def _length(loop: np.ndarray) -> float:
    return float(np.linalg.norm(loop - np.roll(loop, 1, 0), axis=1).sum())
