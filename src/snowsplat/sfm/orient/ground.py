"""The up direction from the ground, a floor or a table: the largest plane below the cameras."""

from __future__ import annotations

import math

import numpy as np

from snowsplat.sfm.orient.cameras import Cameras
from snowsplat.sfm.orient.up import Evidence, isotropic
from snowsplat.util.messages import message

# Standard deviation of the slope of the ground, a table or a street.
_SLOPE = math.radians(3)
# The plane is searched within this angle of the up direction that is known otherwise.
_LARGEST_ANGLE = math.radians(30)
# Points belong to a plane within this share of the distance of the cameras from their points; and
# points farther from the cameras than this many times the distance are not used.
_THICKNESS, _REACH = 0.015, 3.0
# The plane must have this share of the points. Their standard deviation along both of its axes must
# be at least this share of the distance of the cameras from their points: a step is no ground.
_SHARE, _EXTENT = 0.2, 0.15
# Share of the cameras above it.
_BELOW = 0.9
_TRIALS = 1000
_FEWEST = 100


def of_ground(cameras: Cameras, known: Evidence) -> Evidence | None:
    """The normal of the ground; None if there is no large plane below the cameras.

    ``known``: the up direction from other evidence.
    """
    typical = cameras.distance
    points = _near(cameras, _REACH * typical)
    if len(points) < _FEWEST:
        return None
    random = np.random.default_rng(0)
    a, b, c = points[random.integers(0, len(points), (3, _TRIALS))]
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    kept = lengths > 1e-9 * typical**2
    normals, a = normals[kept] / lengths[kept, None], a[kept]
    normals *= np.sign(normals @ known.up)[:, None]
    kept = normals @ known.up > math.cos(_LARGEST_ANGLE)
    normals, a = normals[kept], a[kept]
    if not len(normals):
        return None
    thickness = _THICKNESS * typical
    heights = points @ normals.T - np.einsum("ij,ij->i", a, normals)  # (P, trials)
    above = cameras.centres @ normals.T - np.einsum("ij,ij->i", a, normals) > thickness
    counts = np.where(above.mean(axis=0) >= _BELOW, (np.abs(heights) < thickness).sum(axis=0), 0)
    best = int(counts.argmax())
    inside = np.abs(heights[:, best]) < thickness
    for _ in range(10):
        middle = points[inside].mean(axis=0)
        extents, axes = np.linalg.svd(points[inside] - middle, full_matrices=False)[1:]
        normal = axes[2] * np.sign(axes[2] @ known.up)
        inside = np.abs((points - middle) @ normal) < thickness
        if inside.sum() < _FEWEST:
            return None
    extents = extents / math.sqrt(inside.sum())
    large = inside.mean() > _SHARE and extents[1] > _EXTENT * typical
    below = ((cameras.centres - middle) @ normal > thickness).mean() >= _BELOW
    if not (large and below and normal @ known.up > math.cos(_LARGEST_ANGLE)):
        return None
    return Evidence((message("the ground"),), normal, isotropic(normal, _SLOPE))


def _near(cameras: Cameras, reach: float) -> np.ndarray:
    """The points that are nearer than ``reach`` to a camera."""
    nearest = np.full(len(cameras.points), np.inf)
    for centre in cameras.centres:
        nearest = np.minimum(nearest, np.linalg.norm(cameras.points - centre, axis=1))
    return cameras.points[nearest < reach]
