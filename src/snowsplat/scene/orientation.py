"""The up direction of a scene, estimated from its cameras or its surfaces, and its usual scale."""

import math

import numpy as np

#: The median distance from a camera to the points that it sees, in world units of an oriented
#: scene. One unit is then about one metre for objects and rooms that are photographed by hand.
#: Viewers assume metres for their near planes, for the walking speed, and in VR.
VIEWING_DISTANCE = 3.0

# People hold a camera level to within a few degrees in each photo, but all photos of a dataset may
# look down. So the x axes of the cameras are strong evidence of the up direction, and their y axes
# are weak evidence. These are the assumed standard deviations.
_ROLL = math.radians(3)
_COMMON_PITCH = math.radians(30)
# A photographer also has a habit, which is the same in all photos.
_HABIT = math.radians(1.5)
# A scene keeps its up direction −y if most cameras are level to within this angle, or if their up
# direction differs by less, in standard deviations and as an angle. Datasets that are made with
# sensors are level even if the cameras were not.
_LEVEL = math.sin(math.radians(5))
_UPWARD = math.sin(math.radians(1))  # the upper edges of photos that do not look straight down
_CONTRADICTION, _SAME = 3.0, math.radians(30)
# Largest angle between the up direction and the normals of surfaces parallel to the ground.
_PARALLEL = math.radians(8)
# Largest angle between the usual up direction and that of a scene without cameras.
_LARGEST_TILT = math.radians(40)
# The share of all surfaces that must be parallel to the ground, and their number (that of surfaces
# of the same size with the same variance of the total area). Less may be by chance.
_GROUND = 0.08
_FEWEST = 150
# The lowest part of the heights, and the share of all surfaces that must be ground there for the
# scene to stand on it. At the other end, at most a quarter of that.
_BOTTOM = 0.15
_STANDS = 0.05
# Largest length of the mean of unit vectors that are considered to have no common direction.
_NO_DIRECTION = 0.3


def scene_up(rotations: np.ndarray) -> np.ndarray:
    """The up direction of a scene with cameras: −y, unless the cameras contradict it.

    Many datasets, such as those of COLMAP, have an arbitrary frame. Their up direction is that of
    the cameras. ``rotations`` as in `level_of_cameras`; (3,) unit vector in the world frame.
    """
    usual = np.array([0.0, -1.0, 0.0])
    tilts, upper = np.abs(rotations[:, 0] @ usual), -rotations[:, 1].mean(axis=0)
    if np.median(tilts) < _LEVEL and upper @ usual > _UPWARD:
        return usual
    up, precision = level_of_cameras(rotations)
    away = usual - up
    same = up @ usual > math.cos(_SAME) and away @ precision @ away < _CONTRADICTION**2
    return usual if same else up


def level_of_cameras(rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The up direction of the world, and how certain the cameras are about it.

    It is the most likely direction if the roll of each photo has the standard deviation `_ROLL` and
    the mean pitch of all photos has `_COMMON_PITCH`. If all x axes are parallel, for example in
    front of a wall, the mean pitch decides. Photos whose roll is much larger than `_ROLL` have a
    small weight (Cauchy weights). The covariance includes `_HABIT`.

    ``rotations``: (N, 3, 3) of cam_from_world. Returns a unit vector (3,) in the world frame, and
    the inverse (3, 3) of its covariance, in 1/rad², perpendicular to it.
    """
    x, upper, forward = rotations[:, 0], -rotations[:, 1].mean(axis=0), rotations[:, 2].mean(axis=0)
    # If the upper edges of the photos point in all directions, the photos look straight down (not
    # up: people photograph the ground rather than the sky).
    mean = upper if np.linalg.norm(upper) >= _NO_DIRECTION else -forward
    up = mean / max(float(np.linalg.norm(mean)), 1e-12)
    for _ in range(50):
        roll = x @ up
        weights = 1 / (_ROLL**2 + (roll / 3) ** 2)
        # One Newton step in the plane perpendicular to `up`. The rows of `across` span the plane.
        across = np.linalg.svd(up[None])[2][1:]
        matrix = across @ (x.T * weights @ x) @ across.T + np.eye(2) / _COMMON_PITCH**2
        slope = across @ (x.T @ (weights * roll) - mean / _COMMON_PITCH**2)
        step = -np.linalg.solve(matrix, slope)
        up = up + step @ across
        up /= np.linalg.norm(up)
        if np.linalg.norm(step) < 1e-10:
            break
    # If there are few photos that look down, their upper edges may have a common direction by
    # chance. Then the sign of `up` comes from the viewing directions.
    looks_down = abs(upper @ up) < _NO_DIRECTION
    precision = across.T @ np.linalg.inv(np.linalg.inv(matrix) + _HABIT**2 * np.eye(2)) @ across
    return (-up if looks_down and forward @ up > 0 else up), precision


def up_of_surfaces(
    normals: np.ndarray, areas: np.ndarray, positions: np.ndarray
) -> np.ndarray | None:
    """The up direction of a scene without cameras: the normal of the ground, tables and ceilings.

    It is the direction within `_LARGEST_TILT` of −y, the usual up direction of files, to which most
    surfaces are perpendicular. If there is none, but the scene stands on ground at its lowest z, it
    is z, the up direction of many synthetic scenes; otherwise None. The result is a unit vector
    (3,) in the world frame.

    Args:
        normals: (N, 3) unit vectors in the world frame; their signs are not used.
        areas: (N,) of the surfaces, in any unit.
        positions: (N, 3) of the surfaces in the world frame.
    """
    if float(areas.sum()) <= 0:
        return None
    found = _up_near_minus_y(normals, areas)
    if found is None and _stands_on_z(normals, areas, positions):
        return np.array([0.0, 0.0, 1.0])
    return found


def _stands_on_z(normals: np.ndarray, areas: np.ndarray, positions: np.ndarray) -> bool:
    """Whether a scene stands on ground at its lowest z, as in files whose up direction is z.

    In a dataset whose up direction is −y, the photographer stands there and looks along z, so there
    is no surface.
    """
    low, high = np.quantile(positions[:, 2], [0.01, 0.99])
    height = (positions[:, 2] - low) / max(high - low, 1e-12)
    flat = np.where(np.abs(normals[:, 2]) > math.cos(_PARALLEL), areas, 0.0)
    ground = flat[height < _BOTTOM]
    bottom, top = float(ground.sum()), float(flat[height > 1 - _BOTTOM].sum())
    several = bottom**2 > _FEWEST * float((ground**2).sum())
    return several and bottom > _STANDS * float(areas.sum()) and top < 0.25 * bottom


def _up_near_minus_y(normals: np.ndarray, areas: np.ndarray) -> np.ndarray | None:
    """The direction within `_LARGEST_TILT` of −y to which most surfaces are perpendicular."""
    total = float(areas.sum())

    def around(up: np.ndarray) -> np.ndarray:
        """The areas of surfaces parallel to the ground, 0 for others."""
        return np.where(np.abs(normals @ up) > math.cos(_PARALLEL), areas, 0.0)

    # Directions at equal distances in the cone: a spiral of Fibonacci.
    steps = np.arange(400) + 0.5
    y = 1 - steps / len(steps) * (1 - math.cos(_LARGEST_TILT))
    angle, radius = steps * math.pi * (1 + math.sqrt(5)), np.sqrt(1 - y * y)
    cone = np.stack([radius * np.cos(angle), -y, radius * np.sin(angle)], axis=1)
    up = max(cone, key=lambda direction: float(around(direction).sum()))
    for _ in range(10):  # mean shift
        mean = (np.sign(normals @ up) * around(up)) @ normals
        up = mean / max(float(np.linalg.norm(mean)), 1e-12)
    ground = around(up)
    area = float(ground.sum())
    is_ground = area > _GROUND * total and area**2 > _FEWEST * float((ground**2).sum())
    return up if is_ground and -up[1] > math.cos(_LARGEST_TILT) else None
