"""The up direction, from all that is known about it.

    evidence          what it says                                   usual error
    gimbal            the attitude of each photo of a drone          0.5°
    accelerometer     the direction of gravity in each photo         1°
    cameras           people hold cameras level: no roll             1.5°; along the mean viewing
                                                                     direction up to 30°
    ground            the largest plane below the cameras            3°
    marker            the plane of a printed marker that lies flat   1.5°

Each is a direction with a covariance, and they are combined by these. GPS positions are combined
with the result in `positions`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from snowsplat.scene.orientation import level_of_cameras
from snowsplat.sfm.ingest.photo import Attitude
from snowsplat.sfm.orient.cameras import Cameras
from snowsplat.util.messages import Message, message, plural
from snowsplat.util.names import all_names

# Standard deviations of a single photo, and of the mean of many: sensors are not aligned with the
# lens exactly.
_GIMBAL = (math.radians(2.0), math.radians(0.5))
_ACCELEROMETER = (math.radians(3.0), math.radians(1.0))
#: Of fewer measurements, a wrong one cannot be told from the right ones.
FEWEST = 3
# Standard deviation of the slope of what a marker lies on, and the largest angle to level at which
# it may lie flat.
_PAPER, _LYING = math.radians(1.5), math.radians(20)
# Sensors whose directions differ by more than this from their median are in contradiction.
_LARGEST_SPREAD = math.radians(10)
#: Measurements that differ by more standard deviations contradict each other.
CONTRADICTION = 3.0
# Smaller contradictions are not said: people also tilt a camera, and ground slopes.
_SAID = math.radians(20)
# Evidence with a smaller share of the precision in all directions is not named.
_SHARE = 0.2
# Standard deviation of the slope of the ground, a table or a street.
_SLOPE = math.radians(3)
# The plane is searched within this angle of the up direction that is known otherwise.
_LARGEST_ANGLE = math.radians(30)
# Points belong to a plane within this share of the distance of the cameras from their points; and
# points farther from the cameras than this many times the distance are not used.
_THICKNESS, _REACH = 0.015, 3.0
# The plane must have this share of the points. Their standard deviation along both of its axes must
# be at least this share of the distance of the cameras from their points: a step is no ground.
_OF_POINTS, _EXTENT = 0.2, 0.15
# Share of the cameras above it.
_BELOW = 0.9
_TRIALS = 1000
_FEWEST_POINTS = 100


@dataclass(frozen=True)
class Evidence:
    """An up direction in the world frame of SfM, and how certain it is."""

    names: tuple[Message, ...]  # what it was found from, as text for users
    up: np.ndarray  # (3,) unit vector
    precision: np.ndarray  # (3, 3) inverse covariance in 1/rad², of which ``up`` is the null space

    @property
    def error(self) -> float:
        """The standard deviation in radians, across the direction that is known least."""
        plane = tangent(self.up)
        return 1 / math.sqrt(np.linalg.eigvalsh(plane @ self.precision @ plane.T)[0])


def of_cameras(cameras: Cameras) -> Evidence:
    """The direction in which the photos are level; see `level_of_cameras`."""
    return Evidence(
        (message("the way the photos were held"),), *level_of_cameras(cameras.rotations)
    )


def of_sensors(
    cameras: Cameras, attitudes: Sequence[Attitude | None]
) -> tuple[list[Evidence], list[Message]]:
    """The directions of gimbals and of accelerometers, and doubts as text for users.

    ``attitudes``: one per camera.
    """
    found, doubts = [], []
    for gimbal, name in (
        (True, message("gimbal angles")),
        (False, message("accelerometers")),
    ):
        ups = directions_of(cameras, attitudes, "up", gimbal)
        if len(ups) < FEWEST:
            continue
        mean, spread = robust_mean(ups)
        if spread > _LARGEST_SPREAD:
            doubts.append(
                message(
                    "the {name} of the photos contradict the camera poses (by {angle:.0f}°), so "
                    "they are not used",
                    name=name,
                    angle=math.degrees(spread),
                )
            )
            continue
        each, all_ = _GIMBAL if gimbal else _ACCELEROMETER
        error = math.hypot(max(spread, each) / math.sqrt(len(ups)), all_)
        about = message("the {name} of {n} photos", name=name, n=len(ups))
        found.append(Evidence((about,), mean, isotropic(mean, error)))
    return found, doubts


def directions_of(
    cameras: Cameras,
    attitudes: Sequence[Attitude | None],
    which: Literal["up", "north"],
    gimbal: bool,
) -> np.ndarray:
    """(N, 3) a direction in the world frame, by the gimbals or by the other sensors that tell it.

    ``attitudes``: one per camera.
    """
    rows = [
        rotation.T @ np.array(getattr(attitude, which))
        for rotation, attitude in zip(cameras.rotations, attitudes, strict=True)
        if attitude is not None and attitude.gimbal is gimbal and getattr(attitude, which)
    ]
    return np.array(rows).reshape(-1, 3)


def of_ground(cameras: Cameras, known: Evidence) -> Evidence | None:
    """The normal of the ground; None if there is no large plane below the cameras.

    ``known``: the up direction from other evidence.
    """
    typical = cameras.distance
    nearest = np.full(len(cameras.points), np.inf)
    for centre in cameras.centres:
        nearest = np.minimum(nearest, np.linalg.norm(cameras.points - centre, axis=1))
    points = cameras.points[nearest < _REACH * typical]
    if len(points) < _FEWEST_POINTS:
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
        if inside.sum() < _FEWEST_POINTS:
            return None
    extents = extents / math.sqrt(inside.sum())
    large = inside.mean() > _OF_POINTS and extents[1] > _EXTENT * typical
    below = ((cameras.centres - middle) @ normal > thickness).mean() >= _BELOW
    if not (large and below and normal @ known.up > math.cos(_LARGEST_ANGLE)):
        return None
    return Evidence((message("the ground"),), normal, isotropic(normal, _SLOPE))


def with_markers(
    known: Evidence, normals: np.ndarray, errors: np.ndarray
) -> tuple[Evidence, list[Message]]:
    """The mean of an up direction and the normals of the markers that lie flat, and doubts.

    A marker on a wall or on a slope says nothing about up. Where ``known`` is uncertain, even a
    wall would not contradict it, so there is a limit for the angle, too.

    Args:
        known: the up direction from other evidence.
        normals: (M, 3) unit vectors, M at least 1.
        errors: (M,) their standard deviations in radians.
    """
    angles = np.arccos((normals @ known.up).clip(-1, 1))
    flat = angles < _LYING
    if flat.any():
        name = plural("the marker", "{n} markers", n=int(flat.sum()))
        mean, spread = robust_mean(normals[flat])
        error = math.hypot(max(spread, float(np.median(errors[flat]))), _PAPER)
        markers = Evidence((name,), mean, isotropic(mean, error))
        if _apart(known, markers) < CONTRADICTION:
            return _mean(known, markers), []
    return known, [
        plural(
            "the marker does not lie flat (the angle to level is {angle:.0f}°), so the level is "
            "that of {others} alone",
            "the markers do not lie flat (the angle to level is {angle:.0f}°), so the level is "
            "that of {others} alone",
            n=len(normals),
            angle=math.degrees(angles.min()),
            others=all_names(known.names),
        )
    ]


def robust_mean(units: np.ndarray) -> tuple[np.ndarray, float]:
    """The geometric median (3,) of unit vectors (N, 3), and the median angle from it in radians."""
    mean = np.median(units, axis=0)
    for _ in range(50):
        mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
        away = np.linalg.norm(units - mean, axis=1)
        weights = 1 / np.maximum(away, 1e-4)
        mean = weights @ units
    mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
    angles = 2 * np.arcsin(np.minimum(np.linalg.norm(units - mean, axis=1) / 2, 1))
    return mean, float(np.median(angles))


def combine_evidence(evidence: Sequence[Evidence]) -> tuple[Evidence, list[Message]]:
    """The most likely direction, and contradictions as text for users.

    ``evidence`` begins with what is trusted most. What contradicts the direction found from the
    evidence before is not used.
    """
    best, doubts = evidence[0], []
    for other in evidence[1:]:
        angle = math.acos(min(1.0, max(-1.0, float(best.up @ other.up))))
        if _apart(best, other) < CONTRADICTION:
            best = _mean(best, other)
        elif angle > _SAID:
            doubts.append(
                message(
                    "up differs by {angle:.0f}° between {used} (used) and {other}",
                    angle=math.degrees(angle),
                    used=all_names(best.names),
                    other=all_names(other.names),
                )
            )
    return best, doubts


def _apart(one: Evidence, two: Evidence) -> float:
    """The difference in standard deviations, measured half-way."""
    middle = one.up + two.up
    length = float(np.linalg.norm(middle))
    if length < 1e-6:
        return math.inf
    plane = tangent(middle / length)
    away = plane @ (two.up - one.up)
    covariance = sum(np.linalg.inv(plane @ part.precision @ plane.T) for part in (one, two))
    return math.sqrt(away @ np.linalg.solve(covariance, away))


def _mean(one: Evidence, two: Evidence) -> Evidence:
    """The mean, weighted by the precisions."""
    plane = tangent(one.up)
    precisions = [plane @ part.precision @ plane.T for part in (one, two)]
    inverse = np.linalg.inv(precisions[0] + precisions[1])
    up = one.up + inverse @ precisions[1] @ plane @ (two.up - one.up) @ plane
    up /= np.linalg.norm(up)
    # What has nowhere a share that matters is not named.
    names = tuple(
        name
        for part, precision in zip((one, two), precisions, strict=True)
        if np.linalg.eigvals(inverse @ precision).real.max() > _SHARE
        for name in part.names
    )
    plane = tangent(up)
    total = plane @ (one.precision + two.precision) @ plane.T
    return Evidence(names, up, plane.T @ total @ plane)


def tangent(unit: np.ndarray) -> np.ndarray:
    """(2, 3) orthonormal vectors perpendicular to ``unit``."""
    return np.linalg.svd(unit[None])[2][1:]


def isotropic(unit: np.ndarray, error: float) -> np.ndarray:
    """(3, 3) precision of a direction with the same standard deviation (rad) in all planes."""
    return (np.eye(3) - np.outer(unit, unit)) / error**2
