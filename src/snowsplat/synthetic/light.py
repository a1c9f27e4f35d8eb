"""Illumination of surfaces: a lamp with soft shadows, and ambient light with occlusion.

The light is computed on a coarse grid, because soft shadows vary slowly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

from snowsplat.synthetic.shapes import Shape

_SPACING = 0.015  # metres between the points at which light is computed
_MOST_POINTS = 64  # along each side of a face, approximately
_LIGHT_SAMPLES = 6  # along each side of the lamp
_AMBIENT_DIRECTIONS = 48  # sampled per point
_REACH = 1.2  # metres; objects farther away do not occlude the ambient light
_RAYS = 1 << 14  # per batch, which fits the processor's cache
_MARGIN = 1e-3  # metres, for rounding errors


@dataclass(frozen=True)
class Lamp:
    """A rectangular lamp that radiates downwards, and ambient light."""

    middle: tuple[float, float, float]
    size: tuple[float, float]  # metres, along x and y
    power: float  # irradiance 1 m below a small lamp of this power
    ambient: float  # irradiance of a face without occlusion


def irradiance(
    shape: Shape, face: int, size: tuple[int, int], lamp: Lamp, blockers: Sequence[Shape]
) -> np.ndarray:
    """Irradiance (H, W, 3) of a face of ``size`` (H, W), as the radiance of white matt paint."""
    spacing = max(_SPACING, max(shape.sizes[face]) / _MOST_POINTS)
    rows, columns = (
        int(min(pixels, max(6, round(metres / spacing))))
        for pixels, metres in zip(size, shape.sizes[face][::-1], strict=True)
    )
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    positions, normals = shape.points(face, np.stack([u.ravel(), v.ravel()]))
    positions = positions + np.float32(2e-3) * normals
    light = _direct(lamp, blockers, positions, normals)
    light += _indirect(lamp, blockers, positions, normals)
    planes = light.reshape(3, rows, columns)
    if shape.wraps[face]:  # avoids a visible seam
        planes = np.concatenate([planes[..., -2:], planes, planes[..., :2]], axis=2)
        box = (2, 0, 2 + columns, rows)
    else:
        box = (0, 0, columns, rows)
    resized = [
        Image.fromarray(plane).resize(size[::-1], Image.Resampling.BILINEAR, box)
        for plane in np.ascontiguousarray(planes, np.float32)
    ]
    return np.stack([np.asarray(plane) for plane in resized], axis=-1)


def _direct(
    lamp: Lamp, blockers: Sequence[Shape], positions: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Irradiance (3, P) from the lamp."""
    steps = (np.arange(_LIGHT_SAMPLES) + 0.5) / _LIGHT_SAMPLES - 0.5
    x, y = np.meshgrid(steps * lamp.size[0], steps * lamp.size[1])
    samples = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()]).astype(np.float32)
    samples += np.array(lamp.middle, np.float32)[:, None]
    to_lamp = samples[:, :, None] - positions[:, None]
    distance = np.sqrt((to_lamp * to_lamp).sum(axis=0))
    to_lamp /= distance
    cosine = (to_lamp * normals[:, None]).sum(axis=0).clip(0, None)
    strength = cosine * to_lamp[2].clip(0, None) / distance**2
    if not strength.any():
        return np.zeros_like(positions)
    seen = ~_blocked(blockers, positions, to_lamp, distance)
    warm_white = np.array([[1.0], [0.97], [0.92]], np.float32)
    return warm_white * (seen * strength).mean(axis=0) * np.float32(lamp.power)


def _indirect(
    lamp: Lamp, blockers: Sequence[Shape], positions: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Ambient irradiance (3, P): cold white light, and warm light that near objects reflect.

    The directions are cosine-distributed, so all samples have the same weight.
    """
    i = np.arange(_AMBIENT_DIRECTIONS) + 0.5
    radius, angle = np.sqrt(i / _AMBIENT_DIRECTIONS), i * (math.pi * (3 - math.sqrt(5)))
    own = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)])
    x, y, z = own.astype(np.float32)[:, :, None]
    tangent = np.cross(normals, [[1], [0], [0]], axis=0)
    other = np.cross(normals, [[0], [1], [0]], axis=0)
    tangent = np.where(np.abs(normals[0]) < 0.7, tangent, other).astype(np.float32)
    tangent /= np.sqrt((tangent * tangent).sum(axis=0))
    bitangent = np.cross(normals, tangent, axis=0)
    around = x * tangent[:, None] + y * bitangent[:, None] + z * normals[:, None]
    blocked = _blocked(blockers, positions, around, np.full_like(around[0], _REACH))
    strength = np.float32(lamp.ambient) * (0.75 + 0.25 * around[2])
    white = np.array([0.95, 0.98, 1.05], np.float32)
    warm = np.array([0.42, 0.36, 0.30], np.float32)
    colours = np.where(blocked, warm[:, None, None], white[:, None, None])
    return (colours * strength).mean(axis=1)


def _blocked(
    blockers: Sequence[Shape], positions: np.ndarray, directions: np.ndarray, within: np.ndarray
) -> np.ndarray:
    """(D, P) bool: whether a shape is hit in direction (3, D, P), nearer than ``within`` (D, P)."""
    blocked = np.zeros(within.shape, bool)
    at_once = max(1, _RAYS // positions.shape[1])
    for start in range(0, len(within), at_once):
        part = slice(start, start + at_once)
        blocked[part] = _any_hit(
            blockers, positions, np.ascontiguousarray(directions[:, part]), within[part]
        )
    return blocked


def _any_hit(
    shapes: Sequence[Shape], positions: np.ndarray, directions: np.ndarray, within: np.ndarray
) -> np.ndarray:
    """`_blocked` for as many directions as fit the cache."""
    ends = positions[:, None] + within * directions
    low = np.minimum(positions.min(axis=1), ends.min(axis=(1, 2))) - _MARGIN
    high = np.maximum(positions.max(axis=1), ends.max(axis=(1, 2))) + _MARGIN
    blocked = np.zeros(within.shape, bool)
    for shape in shapes:
        # Most shapes are outside of the bounding box of the rays.
        middle, radius = shape.centre[:, 0], shape.radius
        if (middle + radius < low).any() or (middle - radius > high).any():
            continue
        offset = shape.centre - positions
        # Squared distances of the rays from the centre are `offset2` - `along`².
        along = offset[0] * directions[0]
        along += offset[1] * directions[1]
        along += offset[2] * directions[2]
        offset2 = (offset * offset).sum(axis=0)
        near = along * along > offset2 - (radius + _MARGIN) ** 2
        near &= (along > -radius - _MARGIN) & ~blocked
        near &= along < within + (radius + _MARGIN)
        some = np.flatnonzero(near)
        if len(some):
            origins = positions.take(some % len(offset2), axis=1)
            distance = shape.hit(origins, directions.reshape(3, -1).take(some, axis=1))
            blocked.ravel()[some] = distance < within.ravel()[some]
    return blocked
