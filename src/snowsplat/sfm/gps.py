"""GPS positions in metres, and how far they can be trusted."""

import math
from collections.abc import Sequence

import numpy as np

from snowsplat.sfm.ingest.photo import Photo

#: Standard deviation of a horizontal position in metres, if the receiver states none.
USUAL_ERROR = 5.0

# No receiver is more accurate, in metres.
_LEAST_ERROR = 0.01
# The ellipsoid of WGS 84.
_RADIUS = 6_378_137.0  # m, at the equator
_ECCENTRICITY2 = 6.694379990141e-3


def middle_of(locations: np.ndarray) -> np.ndarray:
    """(3,) the median latitude, longitude and altitude of locations (N, 3)."""
    return locations[0] + np.median(_differences(locations, locations[0]), axis=0)


def east_north_up(locations: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(N, 3) metres east, north and up of ``origin`` (3,).

    Locations (N, 3) are latitudes, longitudes (°) and altitudes (m). The plane is tangent to the
    ellipsoid: exact to a thousandth within 10 km.
    """
    east, north = _metres_per_degree(float(origin[0]))
    return _differences(locations, origin)[:, [1, 0, 2]] * (east, north, 1.0)


def _differences(locations: np.ndarray, origin: np.ndarray) -> np.ndarray:
    differences = locations - origin
    differences[:, 1] = (differences[:, 1] + 180) % 360 - 180  # also across the date line
    return differences


def location_of(place: np.ndarray, origin: np.ndarray) -> tuple[float, float, float]:
    """Latitude, longitude (°) and altitude of ``place`` (3,), the inverse of `east_north_up`."""
    east, north = _metres_per_degree(float(origin[0]))
    longitude = (origin[1] + place[0] / east + 180) % 360 - 180
    return float(origin[0] + place[1] / north), float(longitude), float(origin[2] + place[2])


def _metres_per_degree(latitude: float) -> tuple[float, float]:
    sine = math.sin(math.radians(latitude))
    flattened = 1 - _ECCENTRICITY2 * sine * sine
    across = _RADIUS / math.sqrt(flattened)  # radius of curvature from west to east
    along = across * (1 - _ECCENTRICITY2) / flattened
    east = math.radians(across * math.cos(math.radians(latitude)))
    return max(east, 1e-9), math.radians(along)


def position_errors(photos: Sequence[Photo]) -> np.ndarray:
    """(N,) standard deviations of the horizontal positions in metres, as the receivers state."""
    stated = np.array([photo.location_error or USUAL_ERROR for photo in photos])
    return np.maximum(stated, _LEAST_ERROR)
