"""`Mesh`: triangles with coloured vertices."""

from dataclasses import dataclass

import numpy as np

from snowsplat.scene.origin import HERE, Origin
from snowsplat.util.components import components

#: The fan of a hole has at most this share of the area of the surface: a box lacks one side of 6.
_HOLE = 0.25


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
    across = _across(vertices[faces])
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

    A border is a closed walk along edges that more triangles have in one direction than in the
    other. The outer border of a surface, as of a façade, is kept open: a border whose fan is larger
    than a share of the surface, unless it is the only one.
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    count = len(vertices)
    keys, uses = np.unique(edges[:, 0] * count + edges[:, 1], return_counts=True)
    back = keys % count * count + keys // count
    row = np.searchsorted(keys, back).clip(max=len(keys) - 1)
    more = uses - np.where(keys[row] == back, uses[row], 0)
    following: dict[int, list[int]] = {}
    for key in np.repeat(keys, more.clip(min=0)).tolist():
        following.setdefault(key // count, []).append(key % count)
    # As many of these edges enter a vertex as leave it, so each walk ends where it began.
    loops: list[np.ndarray] = []
    while following:
        walk = [next(iter(following))]
        place = {walk[0]: 0}
        while (ends := following.get(walk[-1])) is not None:
            end = ends.pop()
            if not ends:
                del following[walk[-1]]
            if end not in place:
                place[end] = len(walk)
                walk.append(end)
                continue
            loops.append(np.array(walk[place[end] :]))
            while walk[-1] != end:
                del place[walk.pop()]
    if not loops:
        return vertices, faces
    middles = np.array([vertices[border].mean(0) for border in loops], vertices.dtype)
    vertices, largest = np.concatenate([vertices, middles]), _HOLE * _area(vertices[faces])
    fans = [
        np.stack([np.roll(border, -1), border, np.full(len(border), count + i)], 1)
        for i, border in enumerate(loops)
    ]
    holes = [fan for fan in fans if len(fans) == 1 or _area(vertices[fan]) <= largest]
    return compact_mesh(vertices, np.concatenate([faces, *holes]).astype(faces.dtype))[:2]


def _area(corners: np.ndarray) -> float:
    """Of triangles (F, 3, 3)."""
    return 0.5 * float(np.linalg.norm(_across(corners), axis=1).sum())


def _across(corners: np.ndarray) -> np.ndarray:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
