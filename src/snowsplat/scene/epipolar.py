"""Epipolar geometry of matches: how far they are from what a relative pose says, and how probable
that makes them (MLESAC, Torr and Zisserman 2000).

d is the Sampson distance of a match from the epipolar line, in pixels; infinite if its rays meet
behind a camera. A true match has a normal error of standard deviation σ across the line; a false
one, or one of two photos whose poses are wrong, is anywhere within the distance D, half of the
longer side. The ratio of the densities is r(d) = √(2/π) (D / σ) exp(−d² / 2σ²).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

# Pixels of a photo of this longer side. What bundle adjustment does not model (rolling shutter,
# distortions of higher order) is no smaller in photos of people.
LEAST_NOISE, _OF_SIDE = 0.5, 1600
LEAST_FALSE, _MOST_FALSE = 0.01, 0.5  # bounds of the share ε of false matches
_ROUNDS = 20  # of expectation maximisation
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


def likelihood(distances: Floats, sides: Floats) -> tuple[float, float, float, float]:
    """The logarithm of the likelihood, σ in pixels, ε, and the expected number of true matches.

    Args:
        distances: (M,) of the matches from their epipolar lines in pixels; may be infinite.
        sides: (M,) the longer side of their photos in pixels.
    """
    least = LEAST_NOISE * float(np.mean(sides)) / _OF_SIDE
    noise, false = 4 * least, 0.1
    squares = np.where(np.isfinite(distances), distances, 0.0) ** 2
    for _ in range(_ROUNDS):
        ratio = _ratio(distances, sides, noise)
        true = (1 - false) * ratio / (false + (1 - false) * ratio)
        count = float(true.sum())
        noise = max(least, math.sqrt(float((true * squares).sum()) / max(count, 1e-9)))
        false = min(_MOST_FALSE, max(LEAST_FALSE, 1 - count / len(distances)))
    value = float(log_odds(distances, sides, noise, false).sum())
    return value, noise, false, count


def log_odds(distances: Floats, sides: Floats, noise: float, false: float) -> Floats:
    """(M,) log(ε + (1 − ε) r(d)): how much more probable matches are than if poses said nothing.

    The arguments are those and results of `likelihood`.
    """
    return np.asarray(np.log(false + (1 - false) * _ratio(distances, sides, noise)))


def _ratio(distances: Floats, sides: Floats, noise: float) -> Floats:
    density = np.exp(-0.5 * (distances / noise) ** 2)
    return np.asarray(math.sqrt(2 / math.pi) * (sides / 2) / noise * density)
