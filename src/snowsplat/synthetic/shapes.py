"""Shapes that rays can hit, with texture coordinates on their surfaces.

Rays are (3, R) arrays with one ray per column, so every operation runs over contiguous numbers.
Directions have length 1. A surface has one or more faces, each with coordinates (u, v) from 0 to 1;
v points downwards as in an image. `points` is the inverse of `surface`.
"""

import math
from typing import Protocol

import numpy as np

_FAR = np.float32(np.inf)

Sizes = tuple[tuple[float, float], ...]


class Shape(Protocol):
    centre: np.ndarray  # (3, 1) float32, of a ball that contains the shape
    radius: float  # of that ball; infinite: always test the shape
    sizes: Sizes  # of each face, along u and v, metres (approximate)
    wraps: tuple[bool, ...]  # for each face: whether u = 1 is the same as u = 0

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distances (R,) to the first hits; infinite without a hit."""
        ...

    def surface(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Faces (R,), coordinates (2, R) and outward normals (3, R) of surface points."""
        ...

    def points(self, face: int, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (3, R) and normals (3, R) of the points ``uv`` (2, R) of a face."""
        ...


def _column(*values: float) -> np.ndarray:
    return np.array(values, np.float32)[:, None]


# The faces of a box, ±x, ±y, ±z: the outward, right and down directions, seen from outside.
_OUT = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], np.float32).T
_RIGHT = np.array(
    [[0, -1, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0], [-1, 0, 0], [1, 0, 0]], np.float32
).T
_DOWN = np.cross(_OUT, _RIGHT, axis=0)
_DOWN *= -1


class Box:
    """A box rotated by ``angle`` about the vertical axis; ``inside``: a room seen from inside."""

    def __init__(
        self,
        centre: tuple[float, float, float],
        size: tuple[float, float, float],
        angle: float = 0.0,
        inside: bool = False,
    ) -> None:
        self.centre = _column(*centre)
        self.half = _column(*size) / 2
        self.radius = math.inf if inside else float(np.linalg.norm(self.half))
        self.inside = inside
        cos, sin = math.cos(angle), math.sin(angle)
        self._own_from_world = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]], np.float32)
        x, y, z = size
        self.sizes: Sizes = ((y, z), (y, z), (x, z), (x, z), (x, y), (x, y))
        self.wraps: tuple[bool, ...] = (False,) * 6

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        # Slab method: the ray is between each of three pairs of planes from enter to leave.
        direction = self._own_from_world @ directions
        direction[direction == 0] = 1e-12
        inverse = 1 / direction
        middle = (self._own_from_world @ (self.centre - origins)) * inverse
        reach = self.half * np.abs(inverse)
        leave = (middle + reach).min(axis=0)
        if self.inside:
            return leave
        enter = (middle - reach).max(axis=0)
        return np.where((enter < leave) & (enter > 0), enter, _FAR)

    def surface(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        own = (self._own_from_world @ (positions - self.centre)) / self.half
        axis = np.abs(own).argmax(axis=0)
        face = 2 * axis + (np.take_along_axis(own, axis[None], 0)[0] > 0)
        u = (own * self._right[:, face]).sum(axis=0)
        v = (own * _DOWN[:, face]).sum(axis=0)
        return face, np.stack([u, v]) / 2 + np.float32(0.5), self._normals(face)

    def points(self, face: int, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v = 2 * uv - 1
        faces = np.full(len(u), face)
        own = _OUT[:, faces] + u * self._right[:, faces] + v * _DOWN[:, faces]
        return self._own_from_world.T @ (own * self.half) + self.centre, self._normals(faces)

    @property
    def _right(self) -> np.ndarray:
        return -_RIGHT if self.inside else _RIGHT  # so that textures are not mirrored

    def _normals(self, faces: np.ndarray) -> np.ndarray:
        return self._own_from_world.T @ (-_OUT if self.inside else _OUT)[:, faces]


class Ellipsoid:
    """A ball with a radius for each axis; one face, as a world map: north is up. ``inside``: a dome
    seen from inside, on which the map is mirrored.
    """

    def __init__(
        self,
        centre: tuple[float, float, float],
        radii: tuple[float, float, float],
        inside: bool = False,
    ) -> None:
        self.centre = _column(*centre)
        self.radii = _column(*radii)
        self.radius = math.inf if inside else max(radii)
        self._side = np.float32(-1 if inside else 1)
        self.sizes: Sizes = ((2 * math.pi * max(radii[:2]), math.pi * radii[2]),)
        self.wraps: tuple[bool, ...] = (True,)

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        # In units of its radii, the ellipsoid is a unit ball. The distance of the ray from its
        # centre is computed from the foot of the perpendicular, which avoids cancellation for
        # distant cameras.
        direction = directions / self.radii
        length = np.sqrt((direction * direction).sum(axis=0))
        direction /= length
        to_centre = (self.centre - origins) / self.radii
        along = (to_centre * direction).sum(axis=0)
        foot = to_centre - along * direction
        within = 1 - (foot * foot).sum(axis=0)
        distance = along - self._side * np.sqrt(np.maximum(within, 0))
        return np.where((within > 0) & (distance > 0), distance / length, _FAR)

    def surface(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        own = (positions - self.centre) / self.radii
        u = np.arctan2(own[1], own[0]) / np.float32(2 * math.pi) + np.float32(0.5)
        v = np.arccos(own[2].clip(-1, 1)) / np.float32(math.pi)
        return np.zeros(len(u), np.int64), np.stack([u, v]), self._normals(own)

    def points(self, face: int, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        longitude, colatitude = (uv[0] - 0.5) * (2 * math.pi), uv[1] * math.pi
        own = np.stack(
            [
                np.cos(longitude) * np.sin(colatitude),
                np.sin(longitude) * np.sin(colatitude),
                np.cos(colatitude),
            ]
        ).astype(np.float32)
        return own * self.radii + self.centre, self._normals(own)

    def _normals(self, own: np.ndarray) -> np.ndarray:
        normals = self._side * own / self.radii
        return normals / np.sqrt((normals * normals).sum(axis=0))


class Frustum:
    """A vertical cylinder or truncated cone on ``base``; faces: side, top, bottom."""

    def __init__(
        self, base: tuple[float, float, float], height: float, bottom: float, top: float
    ) -> None:
        self.base, self.height, self.bottom, self.top = _column(*base), height, bottom, top
        self.slope = (top - bottom) / height
        self.centre = self.base + _column(0, 0, height / 2)
        self.radius = math.hypot(height / 2, max(bottom, top))
        self.sizes: Sizes = (
            (2 * math.pi * max(bottom, top), math.hypot(height, top - bottom)),
            (2 * top, 2 * top),
            (2 * bottom, 2 * bottom),
        )
        self.wraps: tuple[bool, ...] = (True, False, False)

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        x, y, z = np.broadcast_to(origins - self.base, directions.shape)
        dx, dy, dz = directions
        nearest = np.full(len(dx), _FAR)

        def take(distance: np.ndarray, valid: np.ndarray) -> None:
            better = valid & (distance > 0) & (distance < nearest)
            nearest[better] = distance[better]

        # (x + s dx)² + (y + s dy)² = (radius at z + s dz)², quadratic in s.
        radius, growth = self.bottom + self.slope * z, self.slope * dz
        a = dx * dx + dy * dy - growth * growth
        b = x * dx + y * dy - radius * growth
        c = x * x + y * y - radius * radius
        with np.errstate(divide="ignore", invalid="ignore"):
            root = np.sqrt(b * b - a * c)
            for distance in ((-b - root) / a, (-b + root) / a):
                level = z + distance * dz
                take(distance, (level >= 0) & (level <= self.height))
            for level, radius_there in ((0.0, self.bottom), (self.height, self.top)):
                distance = (level - z) / dz
                take(
                    distance, (x + distance * dx) ** 2 + (y + distance * dy) ** 2 <= radius_there**2
                )
        return nearest

    def surface(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        x, y, z = positions - self.base
        rho = np.maximum(np.hypot(x, y), np.float32(1e-9))
        off = np.abs([rho - (self.bottom + self.slope * z), z - self.height, z])
        face = off.argmin(axis=0)
        side_u = np.arctan2(y, x) / np.float32(2 * math.pi) + np.float32(0.5)
        cap = np.where(face == 1, self.top, self.bottom).astype(np.float32)
        u = np.where(face == 0, side_u, 0.5 + x / (2 * cap))
        v = np.where(face == 0, 1 - z / self.height, 0.5 - y / (2 * cap))
        return face, np.stack([u, v]).astype(np.float32), self._normals(face, x / rho, y / rho)

    def points(self, face: int, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v = uv
        if face == 0:
            angle, z = (u - 0.5) * (2 * math.pi), self.height * (1 - v)
            radius = self.bottom + self.slope * z
            x, y = radius * np.cos(angle), radius * np.sin(angle)
        else:
            radius = self.top if face == 1 else self.bottom
            x, y, z = (2 * u - 1) * radius, (1 - 2 * v) * radius, 0 * u + self.height * (face == 1)
            angle = 0 * u
        own = np.stack([x, y, z]).astype(np.float32)
        faces = np.full(len(u), face)
        return own + self.base, self._normals(faces, np.cos(angle), np.sin(angle))

    def _normals(self, face: np.ndarray, cos: np.ndarray, sin: np.ndarray) -> np.ndarray:
        length = math.hypot(1, self.slope)
        side = np.stack([cos, sin, np.full_like(cos, -self.slope)]) / length
        cap = np.where(face == 1, 1.0, -1.0)
        return np.where(face == 0, side, np.stack([0 * cap, 0 * cap, cap])).astype(np.float32)


class Ring:
    """A torus whose axis is vertical, or horizontal in the direction ``angle`` if ``upright``.

    Rays are intersected by sphere tracing: a ray can always advance by the distance to the surface.
    """

    _STEPS = 60
    _NEAR = 1e-4  # metres: distance that counts as a hit

    def __init__(
        self,
        centre: tuple[float, float, float],
        ring: float,
        tube: float,
        upright: bool = False,
        angle: float = 0.0,
    ) -> None:
        self.centre = _column(*centre)
        self.ring, self.tube = ring, tube
        self.radius = ring + tube
        self.sizes: Sizes = ((2 * math.pi * (ring + tube), 2 * math.pi * tube),)
        self.wraps: tuple[bool, ...] = (True,)
        cos, sin = math.cos(angle), math.sin(angle)
        rows = [[-sin, cos, 0], [0, 0, 1], [cos, sin, 0]] if upright else np.eye(3)
        self._own_from_world = np.array(rows, np.float32)

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        result = np.full(directions.shape[1], _FAR)
        to_centre = np.broadcast_to(self.centre - origins, directions.shape)
        along = (to_centre * directions).sum(axis=0)
        near2 = (to_centre * to_centre).sum(axis=0) - along * along
        live = np.flatnonzero((along > -self.radius) & (near2 < self.radius**2))
        start = self._own_from_world @ -to_centre[:, live]
        step = self._own_from_world @ directions[:, live]
        # Start at the bounding ball, or at the origin if that is inside.
        distance = np.maximum(along[live] - np.float32(self.radius), 0)
        for _ in range(self._STEPS):
            own = start + distance * step
            ring = np.hypot(own[0], own[1]) - self.ring
            away = np.hypot(ring, own[2]) - np.float32(self.tube)
            found = away < self._NEAR
            result[live[found]] = distance[found]
            distance = distance + away
            advances = ~found & (distance < along[live] + self.radius)
            live, start, step = live[advances], start[:, advances], step[:, advances]
            distance = distance[advances]
            if not len(live):
                break
        return result

    def surface(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        x, y, z = self._own_from_world @ (positions - self.centre)
        around = np.arctan2(y, x)
        across = np.arctan2(z, np.hypot(x, y) - self.ring)
        uv = np.stack([around, -across]) / np.float32(2 * math.pi) + np.float32(0.5)
        return np.zeros(len(x), np.int64), uv, self._normals(around, across)

    def points(self, face: int, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        around, across = (uv[0] - 0.5) * (2 * math.pi), (0.5 - uv[1]) * (2 * math.pi)
        normals = self._normals(around, across)
        circle = np.stack([np.cos(around), np.sin(around), 0 * around]).astype(np.float32)
        middle = self._own_from_world.T @ circle * np.float32(self.ring)
        return self.centre + middle + normals * np.float32(self.tube), normals

    def _normals(self, around: np.ndarray, across: np.ndarray) -> np.ndarray:
        rho = np.cos(across)
        own = np.stack([rho * np.cos(around), rho * np.sin(around), np.sin(across)])
        return self._own_from_world.T @ own.astype(np.float32)
