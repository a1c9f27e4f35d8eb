"""Which way is up, from how cameras are held."""

from __future__ import annotations

import math

import numpy as np

# People hold cameras level to within some degrees, photo by photo, whereas all photos of a dataset
# may look down together. So a photo's x axis tells much about up, and the photos' y axes a little.
_ROLL = math.radians(3)
_COMMON_PITCH = math.radians(30)


def up_direction(rotations: np.ndarray) -> np.ndarray:
    """(3,) unit, world: up, the direction to which the cameras' x axes are most perpendicular.

    ``rotations`` (N, 3, 3) are those of cam_from_world.

    The most likely one if each photo is rolled by `_ROLL` and all together pitched by
    `_COMMON_PITCH`: where the x axes are all parallel, as in front of a wall, the second decides.
    Photos rolled by much more than `_ROLL` lose their say (Cauchy weights).
    """
    x, upper, forward = rotations[:, 0], -rotations[:, 1].mean(axis=0), rotations[:, 2].mean(axis=0)
    # Where the upper edges point every way, photos look straight down, taken on the way to and fro.
    # (People photograph the ground, not the sky.)
    mean = upper if np.linalg.norm(upper) >= 0.3 else -forward
    up = mean / max(float(np.linalg.norm(mean)), 1e-12)
    for _ in range(50):
        roll = x @ up
        weights = 1 / (_ROLL**2 + (roll / 3) ** 2)
        # One Newton step in the plane across `up`, spanned by two rows.
        across = np.linalg.svd(up[None])[2][1:]
        matrix = across @ (x.T * weights @ x) @ across.T + np.eye(2) / _COMMON_PITCH**2
        slope = across @ (x.T @ (weights * roll) - mean / _COMMON_PITCH**2)
        step = -np.linalg.solve(matrix, slope)
        up = up + step @ across
        up /= np.linalg.norm(up)
        if np.linalg.norm(step) < 1e-10:
            break
    # Such photos, if few, may all the same have edges that point one way more than another.
    looks_down = abs(upper @ up) < 0.3
    return -up if looks_down and forward @ up > 0 else up
