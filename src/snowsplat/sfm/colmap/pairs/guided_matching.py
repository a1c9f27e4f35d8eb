"""Matches the features of two photos near their epipolar lines, if the lines are known from a part.

The product of all descriptors takes most of the time. So the largest features, a third of them in
each photo, are matched first: a ninth of the product. If their matches agree with a fundamental
matrix, each feature is then compared only with those near its epipolar line. Matches farther away
would be removed by the verification.

Near the line, there are few features that could show that a match is not distinctive. So instead
of the second nearest feature of the other photo, the ratio test has the look-alikes of both
features in their own photos: a structure that repeats does so there, too, and the nearest of
thousands of unrelated features is equally near in any photo of the scene.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.sfm.colmap.features.extraction import SEED
from snowsplat.sfm.colmap.pairs.matching import (
    Nearest,
    Searched,
    look_alikes,
    match_descriptors,
    mutual,
    two_nearest,
)

_SHARE = 1 / 3  # of the features, which are matched first
# The epipolar lines are known if at least this number of the first matches, and this share of them,
# agrees with a fundamental matrix.
_LEAST, _AGREEING, _CONFIDENCE = 40, 0.7, 0.99
#: Matches with which a model is estimated, before all are compared with it; more take more time.
SAMPLE = 300
# At least this number of these matches must not agree with a homography. The points of a plane do
# not determine the lines.
_OFF_PLANE = 20
# Distance from the line at which features are compared, in units of ``max_error`` of `match`. If a
# smaller share than `_MOST` agrees with the lines, the lens may be a fisheye. The lines are then
# not straight, and the matches must not be only those of a pinhole camera: they tell the lens.
_BAND, _WIDE_BAND, _MOST = 3.0, 8.0, 0.9
# The lines meet in the epipole. Features nearer to it than this share of half the diagonal of the
# photo are compared with all features.
_NEAR = 0.2
_LEVELS = 4096  # of the angles of lines
_FARTHEST = 1e6  # distance of the epipole in units of half the diagonal; beyond, it has no effect

_Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class PhotoSide:
    """The features of a photo, the largest first."""

    camera: pycolmap.Camera
    positions: _Floats  # (N, 2) pixels of the photo
    descriptors: NDArray[np.uint8]  # (N, 128)
    image: int = 0
    # `alike` of photos, by ``image``. It is small, and kept when the descriptors are not.
    known: dict[int, NDArray[np.int32]] = field(default_factory=dict)

    @property
    def alike(self) -> NDArray[np.int32]:
        """`look_alikes` of the descriptors."""
        if self.image not in self.known:
            self.known[self.image] = look_alikes(self.descriptors)
        return self.known[self.image]


def match(first: PhotoSide, second: PhotoSide, max_error: float) -> NDArray[np.uint32]:
    """The matches (K, 2) between the features of two photos: indices, ascending in the first.

    If the epipolar lines are not known from the largest features, these are the matches of
    `match_descriptors`.

    Args:
        max_error: the largest distance of a verified match from its epipolar line, in pixels.

    Raises:
        UserError: the native library is missing or outdated.
    """
    n, m = len(first.positions), len(second.positions)
    some, others = round(_SHARE * n), round(_SHARE * m)
    if min(some, others) < _LEAST:
        return match_descriptors(first.descriptors, second.descriptors)
    part = two_nearest(first.descriptors[:some], second.descriptors[:others])
    lines = _epipolar_lines(first, second, mutual(*part), max_error)
    if lines is None:
        begin = np.where(np.arange(n) < some, others, 0).astype(np.int32)
        rest = Searched(0, begin, np.full(n, m, np.int32))
        whole = two_nearest(first.descriptors, second.descriptors, rest)
        return mutual(_join(part[0], whole[0]), _join(part[1], whole[1]))
    row_order, column_order, searched = _along_lines(first, second, *lines)
    found = two_nearest(first.descriptors[row_order], second.descriptors[column_order], searched)
    alike = first.alike[row_order], second.alike[column_order]
    matches = mutual(_with_look_alikes(found[0], *alike), _with_look_alikes(found[1], *alike[::-1]))
    matches = np.stack([row_order[matches[:, 0]], column_order[matches[:, 1]]], 1)
    return matches[np.argsort(matches[:, 0])].astype(np.uint32)


def _join(part: Nearest, rest: Nearest) -> Nearest:
    """The nearest of two sets, of which ``part`` (K, …) has the smaller indices; ``rest`` (N, …)
    with N ≥ K."""
    made = Nearest(*(column.copy() for column in rest))
    head = Nearest(*(column[: len(part.which)] for column in made))
    head.second[:] = np.maximum(
        np.minimum(part.best, head.best), np.maximum(part.second, head.second)
    )
    head.which[:] = np.where(head.best > part.best, head.which, part.which)
    head.best[:] = np.maximum(head.best, part.best)
    return made


def _epipolar_lines(
    first: PhotoSide, second: PhotoSide, matches: NDArray[np.uint32], max_error: float
) -> tuple[_Floats, float] | None:
    """The fundamental matrix (3, 3) of ``matches`` (K, 2), and the distance from the lines at which
    features are compared, in pixels; None if the matches do not determine the lines."""
    if len(matches) < _LEAST:
        return None
    if not (first.camera.is_perspective_pinhole() and second.camera.is_perspective_pinhole()):
        return None
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = max_error, SEED
    options.min_inlier_ratio, options.min_num_trials = _AGREEING, 0
    options.confidence, options.dyn_num_trials_multiplier = _CONFIDENCE, 1.0
    some = matches[np.linspace(0, len(matches) - 1, min(SAMPLE, len(matches))).astype(int)]
    pixels = first.positions[some[:, 0]], second.positions[some[:, 1]]
    found = pycolmap.estimate_fundamental_matrix(*pixels, options)
    if found is None or found["num_inliers"] < max(_LEAST, _AGREEING * len(some)):
        return None
    agreeing = found["inlier_mask"]
    flat = pycolmap.estimate_homography_matrix(pixels[0][agreeing], pixels[1][agreeing], options)
    if flat is not None and found["num_inliers"] - flat["num_inliers"] < _OFF_PLANE:
        return None
    wide = found["num_inliers"] < _MOST * len(some)
    return np.asarray(found["F"]), (_WIDE_BAND if wide else _BAND) * max_error


def _with_look_alikes(
    nearest: Nearest, own: NDArray[np.int32], other: NDArray[np.int32]
) -> Nearest:
    """``nearest``, where the second one is not less near than the mean of the two look-alikes."""
    alike = (own + other[nearest.which]) // 2
    return nearest._replace(second=np.maximum(nearest.second, alike))


def _along_lines(
    first: PhotoSide, second: PhotoSide, matrix: _Floats, band: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], Searched]:
    """The orders of the features of the two photos around the epipoles, and which are compared.

    Features of the second photo are compared if their distance from the line is at most ``band``
    pixels, or a few times this distance.
    """
    left, _, right = np.linalg.svd(matrix)
    radius, centre = _frame(second.camera)
    epipole = _epipole(left[:, 2], radius, centre)
    distance = np.hypot(*(second.positions - epipole).T)
    near = distance < _NEAR * radius
    angle = _angles(second.positions, epipole, centre)
    least, most = (limit(angle[~near], initial=0.0) for limit in (np.min, np.max))
    per_level = max(float(most - least), 1e-12) / _LEVELS

    def levels(angle: _Floats) -> NDArray[np.int16]:
        return ((angle - least) / per_level).clip(0, _LEVELS - 1).astype(np.int16)

    level = np.where(near, np.int16(-1), levels(angle))
    column_order = np.argsort(level, kind="stable")
    start = np.searchsorted(level[column_order], np.arange(_LEVELS + 1))  # of each level

    # A point on the line of each feature: as far as the border of the photo from the foot of its
    # centre, on the side that is farther from the epipole.
    lines = first.positions @ matrix[:, :2].T + matrix[:, 2]
    lines /= np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-300)[:, None]
    normal = lines[:, :2]
    foot = centre - normal * (normal @ centre + lines[:, 2])[:, None]
    along = np.stack([-normal[:, 1], normal[:, 0]], 1)
    along *= np.where(((foot - epipole) * along).sum(1) < 0, -1.0, 1.0)[:, None]
    angle = _angles(foot + radius * along, epipole, centre)

    reach = float(np.arcsin(min(1.0, band / max(float(distance.min()), _NEAR * radius))))
    # The lines of features near the epipole are inaccurate. An angle of 90° is also one of -90°.
    own_radius, own_centre = _frame(first.camera)
    own = _epipole(right[2], own_radius, own_centre)
    every = np.hypot(*(first.positions - own).T) < _NEAR * own_radius
    every |= np.abs(angle) > np.pi / 2 - reach
    row_order = np.argsort(np.where(every, np.int16(-1), levels(angle)), kind="stable")
    every, angle = every[row_order], angle[row_order]
    begin = np.where(every, 0, start[levels(angle - reach)])
    end = np.where(every, len(second.positions), start[levels(angle + reach) + 1])
    return (
        row_order,
        column_order,
        Searched(int(near.sum()), begin.astype(np.int32), end.astype(np.int32)),
    )


def _frame(camera: pycolmap.Camera) -> tuple[float, _Floats]:
    """Half the diagonal of a photo, and its centre (2,), in pixels."""
    centre = 0.5 * np.array([camera.width, camera.height])
    return float(np.hypot(*centre)), centre


def _epipole(homogeneous: _Floats, radius: float, centre: _Floats) -> _Floats:
    """(2,) in pixels; one that is very far away is moved nearer."""
    offset = homogeneous[:2] - homogeneous[2] * centre
    farthest = _FARTHEST * radius
    least = float(np.linalg.norm(offset)) / farthest
    depth = float(np.copysign(max(abs(homogeneous[2]), least, 1e-300), homogeneous[2]))
    return np.asarray(centre + offset / depth)


def _angles(points: _Floats, epipole: _Floats, centre: _Floats) -> _Floats:
    """(N,) from -π/2 to π/2: the angle between the lines from the ``epipole`` through each of
    ``points`` (N, 2) and through the ``centre`` of the photo."""
    along = centre - epipole
    along /= max(float(np.hypot(*along)), 1e-300)
    rays = points - epipole
    x, y = rays @ along, rays @ np.array([-along[1], along[0]])
    return np.asarray(np.arctan2(np.where(x < 0, -y, y), np.abs(x)))
