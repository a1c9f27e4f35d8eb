"""Finds the photos that have a wrong pose in a model, from their verified matches.

docs/cameras.md describes the method.

If two places look alike, the mapper may register a photo, and then all following photos, at the
wrong place. The reprojection error remains small, because the matches that disagree are dropped. A
pair of photos whose verified matches contradict the model is a *tear*. Correct models have tears,
too: places that look alike have verified matches that are false. So a photo is judged by all of its
matches.

The photos are the nodes of a graph, the pairs with verified matches its edges. The *demand* of an
edge is the squared number of its matches: photos taken side by side have many, and false matches
are few. Matches of photos that follow each other count more (`CheckedPair.weight`). The *support*
of a pair is the share of its matches that the model confirms. The *supported demand* of an edge is
its demand multiplied by the support of its pair.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.scene.epipolar import Floats
from snowsplat.sfm.colmap.checks.matches import read_matches
from snowsplat.sfm.colmap.database import MIN_MATCHES, VerifiedPair, closing_database
from snowsplat.sfm.colmap.lenses.lens import pixels_per_radian
from snowsplat.sfm.colmap.mapping.view_graph import database_names, following_pairs

# The points of a model: their ids (P,), ascending, and their positions (P, 3).
_Points = tuple[NDArray[np.uint64], Floats]
# One photo of a pair: the image, the id of the point that each matched feature observes, and the
# positions (M, 2) of these features in the normalised image plane.
_Side = tuple[pycolmap.Image, NDArray[np.uint64], Floats]

# A match is a hit if its two features observe the same point of the model. It is a miss if one of
# its features observes a point whose projection into the other photo is far from the matched
# feature. The support of a pair is hits / (hits + misses); in a correct model, it is nearly 1.
# Matches whose features observe no point count as neither: the mapper creates no points for
# surfaces that are too far away, or from photos that are too close together. If the share of the
# matches that are hits or misses is below `_MIN_COUNTED`, the poses decide: the support is 1 if the
# share of the matches that agree with the poses is at least `_MIN_AGREEING`,
# otherwise 0.
_MIN_COUNTED = 0.05
_MIN_AGREEING = 0.5
# The model confirms a pair if its support is at least `_CONFIRMED`, and contradicts it if its
# support is at most `_TORN`.
_CONFIRMED = 0.8
_TORN = 0.3
_MIN_MISS_DISTANCE = 4.0  # of a miss, in units of the ``max_error`` of `check_pairs`
#: A model is bent if its agreement is less than this (`agreement_of`). That of right models is 0.98
#: or more, and 0.93 in a room whose carpet repeats; of three bent ones, it is 0.61 to 0.79.
CONSISTENT = 0.92
_WORST, _MIN_WORST = 0.05, 3  # the share of the pairs that `agreement_of` considers, their number


@dataclass(frozen=True)
class CheckedPair(VerifiedPair):
    """Two registered photos, and how many of their verified matches agree with the model."""

    hits: int  # number of matches whose two features observe the same point of the model
    agreeing: float = 0.0  # share of the matches that agree with the poses
    miss_share: float = 0.0  # share of the matches that are misses

    @property
    def hit_share(self) -> float:
        """The share of the matches that are hits."""
        return self.hits / self.matches

    @property
    def support(self) -> float:
        """The share of the matches that the model confirms: from 0 (it contradicts them) to 1."""
        hits, misses = self.hit_share, self.miss_share
        if hits + misses >= _MIN_COUNTED:
            return hits / (hits + misses)
        return float(self.agreeing >= _MIN_AGREEING)

    @property
    def confirmed(self) -> bool:
        """Whether the model confirms the matches."""
        return self.support >= _CONFIRMED

    @property
    def contradicted(self) -> bool:
        """Whether the model contradicts the matches, however few they are."""
        return self.support <= _TORN

    @property
    def torn(self) -> bool:
        """Whether the pair is a tear: it has enough matches, and the model contradicts them."""
        return self.counts and self.contradicted


def agreement_of(pairs: Sequence[CheckedPair]) -> float:
    """How well the poses agree with the matches where they agree least: 0 to 1.

    The strongest pair of each photo counts: its matches are rarely false, unless they are so few
    that unrelated photos may have as many. Where a model is bent, or where parts of different
    scales meet, many of these matches do not agree with the poses, and their features observe no
    point. On repeating structures, some are false: these are misses, and do not count. The result
    is the mean of the pairs of which the least share agrees (`_WORST`, at least `_MIN_WORST`
    pairs): a model of many photos may be bent in one place.
    """
    strongest: dict[int, CheckedPair] = {}
    for pair in [pair for pair in pairs if pair.matches >= MIN_MATCHES] or pairs:
        for photo in (pair.first, pair.second):
            if photo not in strongest or pair.weight > strongest[photo].weight:
                strongest[photo] = pair
    chosen = {(pair.first, pair.second): pair for pair in strongest.values()}.values()

    def share(pair: CheckedPair) -> float:
        return min(1.0, pair.agreeing / max(1e-9, 1 - pair.miss_share))

    worst = sorted(chosen, key=share)[: max(_MIN_WORST, round(_WORST * len(chosen)))]
    total = sum(pair.matches for pair in worst)
    return sum(share(pair) * pair.matches for pair in worst) / total if total else 0.0


def check_pairs(
    model: pycolmap.Reconstruction, database: Path, max_error: float
) -> list[CheckedPair]:
    """Compare the verified matches of each pair of photos with the poses and points of ``model``.

    Pairs are sorted by their image ids. Only photos with a pose are considered.

    ``max_error`` in pixels is the largest distance of a verified match from its epipolar line.
    """
    placed = set(model.reg_image_ids())
    points = {image_id: _point_ids(model.image(image_id)) for image_id in placed}
    ids = np.array(sorted(model.points3D), np.uint64)
    xyz = np.array([model.point3D(int(i)).xyz for i in ids]).reshape(-1, 3)
    with closing_database(database) as source:
        follow = following_pairs(database_names(source))
    checked = []
    for pair in read_matches(database):
        if pair.first not in placed or pair.second not in placed:
            continue
        images = [model.image(i) for i in (pair.first, pair.second)]
        of_first, of_second = (
            points[i][pair.features[:, k]] for k, i in enumerate((pair.first, pair.second))
        )
        is_hit = (of_first == of_second) & (of_first != pycolmap.INVALID_POINT3D_ID)
        focal = np.mean([pixels_per_radian(model.camera(i.camera_id)) for i in images])
        rays = pair.rays(model)
        sides = (images[0], of_first, rays[0]), (images[1], of_second, rays[1])
        largest = _MIN_MISS_DISTANCE * max_error / float(focal)
        missed = _misses((ids, xyz), *sides, largest) | _misses((ids, xyz), *sides[::-1], largest)
        checked.append(
            CheckedPair(
                pair.first,
                pair.second,
                len(is_hit),
                int(is_hit.sum()),
                follows=(pair.first, pair.second) in follow,
                agreeing=float(np.mean(pair.distances(model)[0] <= max_error)),
                miss_share=float(np.mean(missed & ~is_hit)),
            )
        )
    return checked


def _point_ids(image: pycolmap.Image) -> NDArray[np.uint64]:
    """(features,) the id of the point that each feature observes, or ``INVALID_POINT3D_ID``."""
    points = image.points2D
    ids = np.full(len(points), pycolmap.INVALID_POINT3D_ID, np.uint64)
    for row in image.get_observation_point2D_idxs():
        ids[row] = points[row].point3D_id
    return ids


def _misses(model: _Points, one: _Side, other: _Side, max_error: float) -> NDArray[np.bool_]:
    """(M,) whether each match is a miss because of the point that its feature in ``one`` observes.

    The point is projected into the photo ``other``. The match is a miss if the distance between the
    projection and its feature in ``other`` is larger than ``max_error``, in the normalised image
    plane, or if the point is behind the camera of ``other``. For a fisheye lens or a
    panorama, the distance is that of unit vectors.
    """
    _, ids, _ = one
    image, _, rays = other
    missed = np.zeros(len(ids), bool)
    rows = np.flatnonzero(ids != pycolmap.INVALID_POINT3D_ID)
    if len(rows):
        points = model[1][np.searchsorted(model[0], ids[rows])]
        camera = image.cam_from_world().matrix()
        seen = points @ camera[:, :3].T + camera[:, 3]
        if rays.shape[1] == 3:
            seen /= np.linalg.norm(seen, axis=1, keepdims=True)
            missed[rows] = np.linalg.norm(seen - rays[rows], axis=1) > max_error
        else:
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = np.linalg.norm(seen[:, :2] / seen[:, 2:] - rays[rows], axis=1)
            missed[rows] = (seen[:, 2] <= 0) | (distance > max_error)
    return missed
