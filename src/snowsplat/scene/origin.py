"""The origin of a scene that is far away from 0: positions are stored relative to it.

float32 has 24 bits: at 5,400,000 m, the northing of a UTM coordinate, two neighbouring numbers are
half a metre apart. Positions that are read with more digits are therefore moved, in float64, by a
round number near their median. The scene keeps that number as its origin, three floats:

    position in the world = position in memory + origin

The origin is (0, 0, 0) unless the distance makes the move necessary.
"""

import math

import numpy as np

Origin = tuple[float, float, float]

#: The origin of a scene whose positions in memory are those in the world.
HERE: Origin = (0.0, 0.0, 0.0)

# Largest rounding error of positions in float32 that is accepted, relative to the extent.
_PRECISION = 1e-5
_OF_SIZE = 0.01  # the same, relative to the usual size of a Gaussian
_HALF_STEP = 2.0**-24  # largest relative rounding error of float32
_FARTHEST = 1e15  # limit of coordinates; computations in float32 are finite
_SAMPLE = 1 << 16  # points from which median and extent are estimated


def origin_of(points: np.ndarray, size: float = 0.0) -> Origin:
    """The origin for positions in the world; `HERE` if float32 is precise enough without it.

    It is necessary if float32 rounds positions at the median by more than 1e-5 of the extent, that
    is, at more than about 170 times the extent from 0. The extent is twice the distance of the
    quartiles on the widest axis, so a sky or a few outliers do not count. The origin is the median,
    rounded to a power of ten that is at most the extent. An error of 1% of ``size`` is accepted.

    Args:
        points: (N, 3) float64; rows that are not finite are ignored.
        size: the usual size of what is at the points.
    """
    sample = points[:: -(-len(points) // _SAMPLE) or 1]
    sample = sample[np.isfinite(sample).all(1)].astype(np.float64)
    if not len(sample):
        return HERE
    low, middle, high = np.quantile(sample, [0.25, 0.5, 0.75], axis=0)
    extent = 2.0 * float((high - low).max()) or size  # one point has the extent of what is there
    accepted = max(_PRECISION * extent, _OF_SIZE * size)
    if not 0 < extent < math.inf or np.abs(middle).max() * _HALF_STEP <= accepted:
        return HERE
    step = 10.0 ** math.floor(math.log10(extent))
    x, y, z = (round(value / step) * step for value in middle.tolist())
    return (x, y, z)


def stored_origin(value: object) -> Origin | None:
    """The origin that a value from a file stands for; None if it is not three finite numbers."""
    if not isinstance(value, list) or len(value) != 3:
        return None
    if not all(type(x) in (int, float) and abs(x) < _FARTHEST for x in value):
        return None
    x, y, z = map(float, value)
    return (x, y, z)


def opposite(origin: Origin) -> Origin:
    """Where 0 of the world is, seen from ``origin``."""
    return (-origin[0], -origin[1], -origin[2])


def add_origins(a: Origin, b: Origin) -> Origin:
    """The origin of positions relative to ``a`` that are relative to ``b`` themselves."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])
