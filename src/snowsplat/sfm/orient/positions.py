"""Scale, north and level from GPS positions: the similarity that maps the cameras to them.

The positions of a short walk differ by less than their error, and those of a straight walk do not
tell how the scene is rolled about the path. So the similarity is found by weighted least squares
together with the up direction that is known otherwise, and it is used only as far as it is certain.
"""

from dataclasses import dataclass

import numpy as np

from snowsplat.sfm.orient.up import CONTRADICTION, FEWEST, Evidence

# GPS measures altitudes less accurately than horizontal positions, by this factor.
_ALTITUDE = 2.5
# The errors of successive positions are alike: the correlation of neighbours is about 0.8. So the
# positions tell as much as this share of them would with independent errors.
_INDEPENDENT = 0.12
# Standard deviation of the slope of a path whose altitudes are unknown.
_SLOPE = 0.1
# The expected error counts as much as this number of measured errors. With few positions, the
# measured ones are small by chance.
_EXPECTED = 2.0
# Positions that contradict the cameras are outliers, with a small weight. More than this share of
# them says that the positions, or the poses, are wrong.
_MOST_OUTLIERS = 0.4
# The start of the least squares is the best of this number of fits to two positions each, measured
# at this number of positions.
_TRIALS, _POSITIONS = 1000, 1000
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Alignment:
    """Where the cameras are on the earth."""

    scale: float  # metres per unit of SfM
    rotation: np.ndarray  # (3, 3), from the world frame of SfM to east, north, up
    translation: np.ndarray  # (3,) in metres
    # (7, 7) of the rotation vector (rad), log of the scale, and translation (m).
    covariance: np.ndarray
    error: float  # standard deviation of a horizontal position from the cameras, in metres
    outliers: float  # share of the positions, 0..1
    # Difference from the up direction that is known otherwise, in standard deviations.
    up_away: float

    @property
    def scale_error(self) -> float:
        """Relative standard deviation."""
        return float(np.sqrt(self.covariance[3, 3]))

    @property
    def north_error(self) -> float:
        """Standard deviation in radians."""
        return float(np.sqrt(self.covariance[2, 2]))

    @property
    def level_error(self) -> float:
        """Standard deviation in radians, across the direction that is known least."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:2, :2])[1]))

    @property
    def agrees(self) -> bool:
        """Whether the positions confirm the camera poses."""
        return self.outliers <= _MOST_OUTLIERS

    def place(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) of SfM as (N, 3) metres east, north and up."""
        return self.scale * points @ self.rotation.T + self.translation


def align(
    centres: np.ndarray, places: np.ndarray, errors: np.ndarray, known: Evidence
) -> Alignment | None:
    """The most likely similarity; None if there are too few different positions.

    Args:
        centres: (N, 3) camera positions in the world frame of SfM.
        places: (N, 3) of the same cameras by GPS, in metres east, north and up. If all altitudes
            are equal, they are unknown, and the path is assumed to be nearly level.
        errors: (N,) expected standard deviations of the horizontal positions in metres.
        known: the up direction from other evidence.
    """
    if len(np.unique(places[:, :2].round(2), axis=0)) < FEWEST:
        return None
    start = _start(centres, places, known.up)
    if start is None:
        return None
    scale, rotation, translation = start
    middle = np.median(places, axis=0)
    places, translation = places - middle, translation - middle
    has_altitudes = bool(np.ptp(places[:, 2]) > 0)
    relative = errors / np.median(errors)
    expected = float(np.median(errors))
    error = np.array([expected, _ALTITUDE * expected])  # horizontal, vertical
    for _ in range(30):
        turned = scale * centres @ rotation.T
        away = turned + translation - places  # (N, 3) metres
        sizes = np.stack([np.linalg.norm(away[:, :2], axis=1), np.abs(away[:, 2])], axis=1)
        sizes /= relative[:, None]
        error = _error(sizes, error, expected)
        weights = np.minimum(1, CONTRADICTION * error / np.maximum(sizes, 1e-9)) ** 2
        precision = _INDEPENDENT * weights / (relative[:, None] * error) ** 2
        if not has_altitudes:
            precision[:, 1] = 1 / (_SLOPE**2 * np.square(places[:, :2]).sum())
        precision = precision[:, [0, 0, 1]]  # east, north, up
        # (N, 3, 7) derivatives of the positions by the rotation vector, log scale, translation.
        jacobian = np.concatenate(
            [-_cross(turned), turned[:, :, None], np.broadcast_to(np.eye(3), (len(turned), 3, 3))],
            axis=2,
        )
        hessian = np.einsum("nij,ni,nik->jk", jacobian, precision, jacobian)
        slope = np.einsum("nij,ni,ni->j", jacobian, precision, away)
        up = rotation @ known.up
        known_precision = rotation @ known.precision @ rotation.T
        by_rotation = -_cross(up[None])[0]
        hessian[:3, :3] += by_rotation.T @ known_precision @ by_rotation
        slope[:3] += by_rotation.T @ known_precision @ (up - _UP)
        step = -np.linalg.solve(hessian, slope)
        rotation = _rotation(step[:3]) @ rotation
        scale *= float(np.exp(np.clip(step[3], -0.5, 0.5)))
        translation = translation + step[4:]
        if np.abs(step[:4]).max() < 1e-9:
            break
    up_away = rotation @ known.up - _UP
    return Alignment(
        scale,
        rotation,
        translation + middle,
        np.linalg.inv(hessian),
        float(error[0]),
        float((sizes[:, 0] > CONTRADICTION * error[0]).mean()),
        float(np.sqrt(up_away @ known_precision @ up_away)),
    )


def _start(
    centres: np.ndarray, places: np.ndarray, up: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Scale, rotation and translation with this ``up``: the least median of the distances. Half of
    the positions may be wrong (Rousseeuw, "Least median of squares regression", 1984)."""
    east = np.linalg.svd(up[None])[2][1]
    north = np.cross(up, east)
    # Horizontal positions as complex numbers: a factor turns and scales them.
    flat = centres @ east + 1j * (centres @ north)
    target = places[:, 0] + 1j * places[:, 1]
    chosen = np.random.default_rng(0).integers(0, len(flat), (_TRIALS, 2))
    one, two = chosen[np.abs(flat[chosen[:, 0]] - flat[chosen[:, 1]]) > 0].T
    factors = (target[two] - target[one]) / (flat[two] - flat[one])
    one, factors = one[np.abs(factors) > 0], factors[np.abs(factors) > 0]
    if not len(factors):
        return None
    shifts = target[one] - factors * flat[one]
    some = slice(None, None, -(-len(flat) // _POSITIONS))
    away = np.abs(factors[:, None] * flat[some] + shifts[:, None] - target[some])
    medians = np.median(away, axis=1)
    best = int(medians.argmin())
    scale, turn = float(abs(factors[best])), factors[best] / abs(factors[best])
    rotation = np.stack(
        [turn.real * east - turn.imag * north, turn.imag * east + turn.real * north, up]
    )
    height = float(np.median(places[:, 2] - scale * centres @ up))
    return scale, rotation, np.array([shifts[best].real, shifts[best].imag, height])


def _error(sizes: np.ndarray, before: np.ndarray, expected: float) -> np.ndarray:
    """(2,) standard deviations, horizontal and vertical, of distances (N, 2) without outliers.
    ``before``: an earlier estimate, which tells the outliers."""
    limits = CONTRADICTION * np.maximum(before, np.median(sizes, axis=0))
    across, above = (size[size <= limit] for size, limit in zip(sizes.T, limits, strict=True))
    # Four unknowns are fitted to the horizontal positions, three to the altitudes.
    horizontal = (np.square(across).sum() + 2 * _EXPECTED * expected**2) / (
        max(0, 2 * len(across) - 4) + 2 * _EXPECTED
    )
    vertical = (np.square(above).sum() + _EXPECTED * _ALTITUDE**2 * horizontal) / (
        max(0, len(above) - 3) + _EXPECTED
    )
    return np.sqrt(np.array([horizontal, vertical]))


def _cross(vectors: np.ndarray) -> np.ndarray:
    """(N, 3, 3) matrices of the cross products with vectors (N, 3) from the left."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _rotation(vector: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    cross = _cross(vector[None])[0]
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + first * cross + second * cross @ cross
