"""The up direction of a scene, estimated from its cameras, and the scale of an oriented scene."""

from __future__ import annotations

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
# Largest length of the mean of unit vectors that are considered to have no common direction.
_NO_DIRECTION = 0.3


def up_direction(rotations: np.ndarray) -> np.ndarray:
    """The up direction of the world: the one most perpendicular to the x axes of the cameras.

    It is the most likely direction if the roll of each photo has the standard deviation `_ROLL` and
    the mean pitch of all photos has `_COMMON_PITCH`. If all x axes are parallel, for example in
    front of a wall, the mean pitch decides. Photos whose roll is much larger than `_ROLL` have a
    small weight (Cauchy weights).

    Args:
        rotations: (N, 3, 3) rotations of cam_from_world.

    Returns:
        (3,) unit vector in the world frame.
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
    return -up if looks_down and forward @ up > 0 else up
