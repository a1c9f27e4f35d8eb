"""Epipolar geometry of matches: how far they are from what a relative pose says."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

_MIN_ANGLE = 2.0  # degrees: two rays with a smaller angle between them count as parallel


def homogeneous(points: Floats) -> Floats:
    """(M, 3): a copy of ``points`` (M, 2) in an image plane with z = 1, or of rays (M, 3)."""
    if points.shape[1] == 3:
        return points.copy()
    return np.pad(points, ((0, 0), (0, 1)), constant_values=1)


def sampson_distances(matrix: Floats, first: Floats, second: Floats) -> Floats:
    """(M,) the Sampson distances of matches from the epipolar lines of a fundamental or essential
    ``matrix`` (3, 3), in the unit of the points.

    ``first``, ``second``: (M, 2) positions in the image planes of the two photos, or (M, 3) unit
    vectors.
    """
    one, two = homogeneous(first), homogeneous(second)
    lines, others = one @ matrix.T, two @ matrix
    # The squared gradient of the product below, along the image plane or the sphere. There, the
    # part across the sphere is zero on the epipolar line, and small near it.
    squares = (lines[:, : second.shape[1]] ** 2).sum(1) + (others[:, : first.shape[1]] ** 2).sum(1)
    return np.asarray(np.abs((two * lines).sum(1)) / np.sqrt(np.maximum(squares, 1e-300)))


def distances_of_matches(
    rotation: Floats, translation: Floats, rays1: Floats, rays2: Floats
) -> Floats:
    """(M,) Sampson distances; infinite where the two rays do not meet in front of both cameras.

    Nearly parallel rays meet far away, in front or behind by chance, so they count as meeting.

    Args:
        rotation, translation: (3, 3) and (3,), the second camera from the first one.
        rays1, rays2: (M, 2) positions of the matched features in the normalised image planes of the
            two cameras, or (M, 3) unit vectors. The distances have the same unit.
    """
    x, y, z = translation
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    distance = sampson_distances(essential, rays1, rays2)
    one, two = homogeneous(rays1), homogeneous(rays2)
    # depth1 · one + translation ≈ depth2 · two, with both rays in the frame of the second camera.
    one = one @ rotation.T
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    two /= np.linalg.norm(two, axis=1, keepdims=True)
    cosine = (one * two).sum(1)
    along1, along2 = one @ translation, two @ translation
    is_in_front = (cosine * along2 > along1) & (along2 > cosine * along1)
    is_parallel = cosine > np.cos(np.radians(_MIN_ANGLE))
    return np.where(is_in_front | is_parallel, distance, np.inf)
