"""Epipolar geometry of matches: `sampson_distances`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]


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
