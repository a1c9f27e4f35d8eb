"""Textured shapes with precomputed illumination, and the radiance along rays.

The lamp does not move and most surfaces are matt, so the radiance of a point does not depend on the
viewing direction. Direct light with soft shadows and ambient light with occlusion are computed once
and multiplied into the textures. Then a ray needs only an intersection and a texture
look-up. Only gloss depends on the viewing direction and needs one reflected ray.

Surfaces are illuminated by a lamp with soft shadows, and ambient light with occlusion. The light is
computed on a coarse grid, because soft shadows vary slowly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

from snowsplat.synthetic.shapes import Shape
from snowsplat.util.srgb import to_linear

_LEVELS = 5  # each texture is stored at 1, 1/2 … 1/16 of its size
_BLOCK = 1 << 14  # rays per batch; a batch fits into the processor's cache
_SPACING = 0.015  # metres between the points at which light is computed
_MOST_POINTS = 64  # along each side of a face, approximately
_LIGHT_SAMPLES = 6  # along each side of the lamp
_AMBIENT_DIRECTIONS = 48  # sampled per point
_REACH = 1.2  # metres; objects farther away do not occlude the ambient light
_RAYS = 1 << 14  # per batch, which fits the processor's cache
_MARGIN = 1e-3  # metres, for rounding errors


@dataclass(frozen=True)
class SceneObject:
    """A shape and its textures."""

    shape: Shape
    paint: Sequence[np.ndarray]  # one for each face, or one for all: sRGB (H, W, 3), 0 to 1
    gloss: float = 0.0  # reflectance at normal incidence (Schlick's approximation)
    emissive: bool = False  # whether it radiates the colour of its texture; then it casts no shadow


class Scene:
    """A lit scene. `radiance` returns linear light, in which 1 is white in a photo."""

    def __init__(self, objects: Sequence[SceneObject], lamp: Lamp) -> None:
        self.shapes = [item.shape for item in objects]
        self._gloss = np.array([item.gloss for item in objects], np.float32)
        blockers = [
            item.shape for item in objects if math.isfinite(item.shape.radius) and not item.emissive
        ]  # infinite shapes are rooms, whose walls cast no shadow on the objects inside
        textures: list[np.ndarray] = []
        texels, wraps, firsts = [], [], []
        for item in objects:
            firsts.append(len(textures))
            for face, size in enumerate(item.shape.sizes):
                srgb = item.paint[face % len(item.paint)]
                # Values above 1 are brighter than white.
                paint = np.where(srgb > 1, srgb, to_linear(srgb.clip(0, 1))).astype(np.float32)
                if not item.emissive:
                    paint = paint * irradiance(item.shape, face, paint.shape[:2], lamp, blockers)
                textures.append(paint)
                height, width = paint.shape[:2]
                texels.append(math.sqrt(size[0] / width * size[1] / height))
                wraps.append(item.shape.wraps[face])
        self._first_texture = np.array(firsts)
        self._texels, self._wraps = np.array(texels, np.float32), np.array(wraps)
        self._store(textures)

    def _store(self, textures: Sequence[np.ndarray]) -> None:
        """Store all textures at all levels in one array, so that one look-up serves all rays."""
        texels: list[np.ndarray] = []
        starts, widths, heights = (np.zeros((len(textures), _LEVELS), np.int32) for _ in range(3))
        total = 0
        for i, texture in enumerate(textures):
            for level in range(_LEVELS):
                heights[i, level], widths[i, level] = texture.shape[:2]
                starts[i, level] = total
                total += texture.shape[0] * texture.shape[1]
                texels.append(texture.reshape(-1, 3))
                if level + 1 < _LEVELS:
                    texture = _halved(texture)
        self._all = np.concatenate(texels).astype(np.float32)
        self._starts, self._widths, self._heights = starts, widths, heights

    def radiance(self, origins: np.ndarray, directions: np.ndarray, spread: float) -> np.ndarray:
        """Linear colours (3, R) along rays; black where they hit nothing.

        Args:
            origins: (3, 1) or (3, R) float32, metres.
            directions: (3, R) float32, of length 1.
            spread: width of a ray at distance 1, which selects the texture level.
        """
        result = np.zeros_like(directions)
        for start in range(0, directions.shape[1], _BLOCK):
            block = slice(start, start + _BLOCK)
            own = origins if origins.shape[1] == 1 else origins[:, block]
            result[:, block] = self.block(own, directions[:, block], spread, mirrored=True)
        return result

    def nearest(
        self, origins: np.ndarray, directions: np.ndarray, candidates: Sequence[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distances (R,) to the first hits, and the indices (R,) of their shapes; -1: no hit."""
        count = directions.shape[1]
        nearest = np.full(count, np.inf, np.float32)
        owner = np.full(count, -1)
        for i in candidates:
            distance = self.shapes[i].hit(origins, directions)
            closer = distance < nearest
            np.copyto(nearest, distance, where=closer)
            owner[closer] = i
        return nearest, owner

    def block(
        self, origins: np.ndarray, directions: np.ndarray, spread: float, mirrored: bool
    ) -> np.ndarray:
        """`radiance` of rays that are computed at once; ``mirrored``: surfaces reflect."""
        count = directions.shape[1]
        candidates = self.candidates(origins, directions)
        nearest, owner = self.nearest(origins, directions, candidates)
        positions = origins + np.where(owner >= 0, nearest, 0) * directions
        texture = np.zeros(count, np.int64)
        uv, normals = np.zeros((2, count), np.float32), np.zeros_like(directions)
        for i in candidates:
            own = np.flatnonzero(owner == i)
            face, uv[:, own], normals[:, own] = self.shapes[i].surface(positions[:, own])
            texture[own] = self._first_texture[i] + face
        cosine = np.maximum(-(directions * normals).sum(axis=0), np.float32(0.02))
        # The footprint on a slanted surface is longer in one direction: use the geometric mean.
        footprint = nearest * np.float32(spread) / np.sqrt(cosine)
        colours = self._look_up(texture, uv, footprint)
        colours[:, owner < 0] = 0
        if mirrored:
            glossy = np.flatnonzero((self._gloss[owner] > 0) & (owner >= 0))
            self.mirror(
                colours, glossy, owner[glossy], positions[:, glossy], normals, directions, spread
            )
        return colours

    def mirror(
        self,
        colours: np.ndarray,
        rays: np.ndarray,
        owner: np.ndarray,
        positions: np.ndarray,
        normals: np.ndarray,
        directions: np.ndarray,
        spread: float,
    ) -> None:
        """Add the light that surfaces reflect to ``colours`` (3, R), in place.

        ``rays`` (M,) are the indices of the rays that hit the surfaces, at ``positions`` (3, M),
        and ``owner`` (M,) those of their shapes; ``normals`` and ``directions`` (3, R) of all rays.
        """
        if not len(rays):
            return
        normal, gloss = normals[:, rays], self._gloss[owner]
        facing = np.maximum(-(directions[:, rays] * normal).sum(axis=0), np.float32(0.02))
        share = gloss + (1 - gloss) * (1 - facing) ** 5
        onward = directions[:, rays] + 2 * facing * normal
        onward /= np.sqrt((onward * onward).sum(axis=0))
        start = positions + np.float32(2e-3) * normal
        seen = self.block(start, onward, 3 * spread, mirrored=False)
        colours[:, rays] += share * (seen - colours[:, rays])

    def candidates(self, origins: np.ndarray, directions: np.ndarray) -> list[int]:
        """Indices of shapes whose bounding sphere intersects the cone of the rays."""
        if origins.shape[1] > 1:
            return list(range(len(self.shapes)))
        axis = directions.mean(axis=1, keepdims=True)
        axis /= np.linalg.norm(axis)
        opening = math.acos(min(1.0, float((axis * directions).sum(axis=0).min())))
        kept = []
        for i, shape in enumerate(self.shapes):
            offset = shape.centre - origins
            distance = float(np.linalg.norm(offset))
            if distance > shape.radius:
                angle = math.acos(max(-1.0, min(1.0, float((axis * offset).sum()) / distance)))
                if angle > opening + math.asin(shape.radius / distance) + 1e-4:
                    continue
            kept.append(i)
        return kept

    def _look_up(self, texture: np.ndarray, uv: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Colours (3, R), bilinear, at the level whose texels are about as large as a ray."""
        with np.errstate(divide="ignore", invalid="ignore"):
            level = np.rint(np.log2(footprint / self._texels[texture]))
        level = np.nan_to_num(level, posinf=0).clip(0, _LEVELS - 1).astype(np.int64)
        start = self._starts[texture, level]
        width, height = self._widths[texture, level], self._heights[texture, level]
        x = uv[0] * width - np.float32(0.5)
        y = (uv[1] * height - np.float32(0.5)).clip(0, height - 1)
        left, upper = np.floor(x), np.floor(y)
        wx, wy = (x - left).astype(np.float32)[:, None], (y - upper).astype(np.float32)[:, None]
        x0, y0 = left.astype(np.int32), upper.astype(np.int32)
        wraps = self._wraps[texture]
        columns = [
            np.where(wraps, column % width, column.clip(0, width - 1)) for column in (x0, x0 + 1)
        ]
        rows = [start + row * width for row in (y0, np.minimum(y0 + 1, height - 1))]
        corners = [[self._all[row + column] for column in columns] for row in rows]
        (a, b), (c, d) = corners
        top, bottom = a + wx * (b - a), c + wx * (d - c)
        return np.ascontiguousarray((top + wy * (bottom - top)).T)


def _halved(texture: np.ndarray) -> np.ndarray:
    """The texture at half the size: means of 2 x 2 texels; odd sizes are resampled."""
    height, width = (max(1, side // 2) for side in texture.shape[:2])
    if texture.shape[0] != 2 * height or texture.shape[1] != 2 * width:
        planes = [
            Image.fromarray(np.ascontiguousarray(texture[..., c])).resize(
                (width, height), Image.Resampling.BOX
            )
            for c in range(3)
        ]
        return np.stack([np.asarray(plane) for plane in planes], axis=-1)
    return texture.reshape(height, 2, width, 2, 3).mean(axis=(1, 3))


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
