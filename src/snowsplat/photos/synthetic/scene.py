"""Shapes with paint on them, lit once and for all, and what a ray sees of them.

Light does not move and most surfaces are matt, so how bright each point is does not depend on who
looks: direct light with its soft shadows, and light from all around with its occlusion, are
computed when the scene is made, on a coarse grid of each face, and multiplied into the paint. A ray
then costs an intersection and a look into a picture. Gloss is what depends on the eye: one more
ray, mirrored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

from snowsplat.photos.synthetic.shapes import Shape

_LEVELS = 5  # each texture is kept at 1, 1/2 … 1/16 of its size
_LIGHT_GRID = 0.015, 64  # light is computed every so many metres, but at this many points a side
_LIGHT_SAMPLES = 6  # along each side of the lamp
_AROUND = 48  # directions in which light from all around is looked for
_REACH = 1.2  # metres; what is farther does not shade from that light
_BLOCK = 1 << 14  # rays at a time, so that their numbers stay in the processor's cache


@dataclass(frozen=True)
class Thing:
    """A shape and its paint."""

    shape: Shape
    paint: Sequence[np.ndarray]  # one for each face, or one for all: sRGB (H, W, 3), 0 to 1
    gloss: float = 0.0  # share of light mirrored head-on; more at grazing angles (Schlick)
    shines: bool = False  # as bright as its paint, whatever light falls on it; casts no shadow


@dataclass(frozen=True)
class Lamp:
    """A rectangle of light that shines down, and the light from all around."""

    middle: tuple[float, float, float]
    size: tuple[float, float]  # metres, along x and y
    power: float  # irradiance right below it at 1 m, were it small
    around: float  # irradiance of a face that sees nothing near


class Scene:
    """What `radiance` looks at: linear light, 1 is white in a photo."""

    def __init__(self, things: Sequence[Thing], lamp: Lamp) -> None:
        self._shapes = [thing.shape for thing in things]
        self._gloss = np.array([thing.gloss for thing in things], np.float32)
        # Whoever is within a room is not shaded by its walls.
        self._blockers = [
            thing.shape
            for thing in things
            if math.isfinite(thing.shape.radius) and not thing.shines
        ]
        self._lamp = lamp
        textures, texels, wraps, firsts = [], [], [], []
        for thing in things:
            firsts.append(len(textures))
            for face, size in enumerate(thing.shape.sizes):
                paint = _linear(thing.paint[face % len(thing.paint)])
                if not thing.shines:
                    paint = paint * self._light(thing.shape, face, paint.shape[:2])
                textures.append(paint)
                height, width = paint.shape[:2]
                texels.append(math.sqrt(size[0] / width * size[1] / height))
                wraps.append(thing.shape.wraps[face])
        self._first_texture = np.array(firsts)
        self._texels, self._wraps = np.array(texels, np.float32), np.array(wraps)
        self._store(textures)

    def _store(self, textures: Sequence[np.ndarray]) -> None:
        """All textures at all levels in one array, so that one look-up serves all rays."""
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

    def _light(self, shape: Shape, face: int, size: tuple[int, int]) -> np.ndarray:
        """Irradiance (H, W, 3) over a face."""
        spacing = max(_LIGHT_GRID[0], max(shape.sizes[face]) / _LIGHT_GRID[1])
        rows, columns = (
            int(min(pixels, max(6, round(metres / spacing))))
            for pixels, metres in zip(size, shape.sizes[face][::-1], strict=True)
        )
        u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
        positions, normals = shape.points(face, np.stack([u.ravel(), v.ravel()]))
        positions = positions + np.float32(2e-3) * normals
        light = self._direct(positions, normals) + self._indirect(positions, normals)
        planes = light.reshape(3, rows, columns)
        if shape.wraps[face]:  # so that the seam is not seen
            planes = np.concatenate([planes[..., -2:], planes, planes[..., :2]], axis=2)
            box = (2, 0, 2 + columns, rows)
        else:
            box = (0, 0, columns, rows)
        resized = [
            Image.fromarray(plane).resize(size[::-1], Image.Resampling.BILINEAR, box)
            for plane in np.ascontiguousarray(planes, np.float32)
        ]
        return np.stack([np.asarray(plane) for plane in resized], axis=-1)

    def _direct(self, positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Irradiance (3, P) from the lamp."""
        steps = (np.arange(_LIGHT_SAMPLES) + 0.5) / _LIGHT_SAMPLES - 0.5
        x, y = np.meshgrid(steps * self._lamp.size[0], steps * self._lamp.size[1])
        samples = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()]).astype(np.float32)
        samples += np.array(self._lamp.middle, np.float32)[:, None]
        to_lamp = samples[:, :, None] - positions[:, None]
        distance = np.sqrt((to_lamp * to_lamp).sum(axis=0))
        to_lamp /= distance
        cosine = (to_lamp * normals[:, None]).sum(axis=0).clip(0, None)
        strength = cosine * to_lamp[2].clip(0, None) / distance**2
        if not strength.any():
            return np.zeros_like(positions)
        seen = ~self._blocked(positions, to_lamp, distance)
        warm_white = np.array([[1.0], [0.97], [0.92]], np.float32)
        return warm_white * (seen * strength).mean(axis=0) * np.float32(self._lamp.power)

    def _indirect(self, positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Irradiance (3, P) from all around: the ceiling brighter, and warm light off what is near.

        The directions are distributed like the cosine, so that each counts the same.
        """
        i = np.arange(_AROUND) + 0.5
        radius, angle = np.sqrt(i / _AROUND), i * (math.pi * (3 - math.sqrt(5)))
        own = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)])
        x, y, z = own.astype(np.float32)[:, :, None]
        tangent = np.cross(normals, [[1], [0], [0]], axis=0)
        other = np.cross(normals, [[0], [1], [0]], axis=0)
        tangent = np.where(np.abs(normals[0]) < 0.7, tangent, other).astype(np.float32)
        tangent /= np.sqrt((tangent * tangent).sum(axis=0))
        bitangent = np.cross(normals, tangent, axis=0)
        around = x * tangent[:, None] + y * bitangent[:, None] + z * normals[:, None]
        blocked = self._blocked(positions, around, np.full_like(around[0], _REACH))
        strength = np.float32(self._lamp.around) * (0.75 + 0.25 * around[2])
        white = np.array([0.95, 0.98, 1.05], np.float32)
        warm = np.array([0.42, 0.36, 0.30], np.float32)
        colours = np.where(blocked, warm[:, None, None], white[:, None, None])
        return (colours * strength).mean(axis=1)

    def _blocked(
        self, positions: np.ndarray, directions: np.ndarray, within: np.ndarray
    ) -> np.ndarray:
        """Whether (D, P) something is in the direction (3, D, P), nearer than ``within`` (D, P)."""
        middle = positions.mean(axis=1, keepdims=True)
        reach = float(np.linalg.norm(positions - middle, axis=0).max() + within.max())
        shapes = [s for s in self._blockers if np.linalg.norm(s.centre - middle) < reach + s.radius]
        blocked = np.zeros(within.shape, bool)
        at_once = max(1, _BLOCK // positions.shape[1])
        for start in range(0, len(within), at_once):
            part = slice(start, start + at_once)
            count = len(within[part])
            blocked[part] = _any_hit(
                shapes,
                np.tile(positions, count),
                directions[:, part].reshape(3, -1),
                within[part].ravel(),
            ).reshape(count, -1)
        return blocked

    def radiance(
        self, origins: np.ndarray, directions: np.ndarray, spread: float, mirrored: bool = True
    ) -> np.ndarray:
        """Linear colours (3, R) that rays see; black where there is nothing.

        Args:
            origins: (3, 1) or (3, R) float32, metres.
            directions: (3, R) float32, of length 1.
            spread: width of a ray at a distance of 1, for the level of a texture that it reads.
            mirrored: follow rays on from glossy things, once.
        """
        result = np.zeros_like(directions)
        for start in range(0, directions.shape[1], _BLOCK):
            block = slice(start, start + _BLOCK)
            own = origins if origins.shape[1] == 1 else origins[:, block]
            result[:, block] = self._block(own, directions[:, block], spread, mirrored)
        return result

    def _block(
        self, origins: np.ndarray, directions: np.ndarray, spread: float, mirrored: bool
    ) -> np.ndarray:
        count = directions.shape[1]
        nearest = np.full(count, np.inf, np.float32)
        owner = np.full(count, -1)
        for i in self._candidates(origins, directions):
            distance = self._shapes[i].hit(origins, directions)
            closer = distance < nearest
            np.copyto(nearest, distance, where=closer)
            owner[closer] = i
        positions = origins + np.where(owner >= 0, nearest, 0) * directions
        texture, uv, normals = np.zeros(count, np.int64), np.zeros_like(directions)[:2], positions
        normals = np.zeros_like(directions)
        for i in np.unique(owner[owner >= 0]):
            own = np.flatnonzero(owner == i)
            face, uv[:, own], normals[:, own] = self._shapes[i].surface(positions[:, own])
            texture[own] = self._first_texture[i] + face
        cosine = np.maximum(-(directions * normals).sum(axis=0), np.float32(0.02))
        # A slanted surface is seen smaller one way only: the root is between the two ways.
        footprint = nearest * np.float32(spread) / np.sqrt(cosine)
        colours = self._look_up(texture, uv, footprint)
        colours[:, owner < 0] = 0
        glossy = np.flatnonzero((self._gloss[owner] > 0) & (owner >= 0)) if mirrored else ()
        if len(glossy):
            facing, normal = cosine[glossy], normals[:, glossy]
            gloss = self._gloss[owner[glossy]]
            share = gloss + (1 - gloss) * (1 - facing) ** 5
            onward = directions[:, glossy] + 2 * facing * normal
            onward /= np.sqrt((onward * onward).sum(axis=0))
            start = positions[:, glossy] + np.float32(2e-3) * normal
            seen = self._block(start, onward, 3 * spread, mirrored=False)
            colours[:, glossy] += share * (seen - colours[:, glossy])
        return colours

    def _candidates(self, origins: np.ndarray, directions: np.ndarray) -> list[int]:
        """The shapes that rays from one point may hit: those whose ball touches their cone."""
        if origins.shape[1] > 1:
            return list(range(len(self._shapes)))
        axis = directions.mean(axis=1, keepdims=True)
        axis /= np.linalg.norm(axis)
        opening = math.acos(min(1.0, float((axis * directions).sum(axis=0).min())))
        kept = []
        for i, shape in enumerate(self._shapes):
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


def _any_hit(
    shapes: Sequence[Shape], origins: np.ndarray, directions: np.ndarray, within: np.ndarray
) -> np.ndarray:
    """Whether (R,) a ray hits one of the shapes nearer than ``within`` (R,)."""
    blocked = np.zeros(len(within), bool)
    for shape in shapes:
        offset = shape.centre - origins
        along = np.einsum("kr,kr->r", offset, directions)
        off2 = np.einsum("kr,kr->r", offset, offset) - along * along
        near = (off2 < shape.radius**2) & (along > -shape.radius) & ~blocked
        near &= along < within + shape.radius
        some = np.flatnonzero(near)
        if len(some):
            blocked[some] = shape.hit(origins[:, some], directions[:, some]) < within[some]
    return blocked


def _linear(srgb: np.ndarray) -> np.ndarray:
    """Light of sRGB values; above 1, light that is brighter than white, as it is."""
    low, high = srgb / 12.92, ((srgb.clip(0, 1) + 0.055) / 1.055) ** 2.4
    return np.where(srgb > 1, srgb, np.where(srgb <= 0.04045, low, high)).astype(np.float32)


def _halved(texture: np.ndarray) -> np.ndarray:
    """Each 2 x 2 averaged; an odd last row or column is stretched over."""
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
