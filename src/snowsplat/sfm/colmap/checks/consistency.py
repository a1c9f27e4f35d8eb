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

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.data.lens.models import lens_of
from snowsplat.scene.epipolar import Floats, distances_of_matches
from snowsplat.sfm.colmap.database import VerifiedPair, closing_database, verified_pairs
from snowsplat.sfm.colmap.features.extraction import SEED
from snowsplat.sfm.colmap.lenses.lens import is_fisheye, pixels_per_radian
from snowsplat.sfm.colmap.mapping.view_graph import database_names, following_pairs

Ints = NDArray[np.integer[Any]]
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
# share of the matches that agree with the poses (`agreement`) is at least `_MIN_AGREEING`,
# otherwise 0.
_MIN_COUNTED = 0.05
_MIN_AGREEING = 0.5
# The model confirms a pair if its support is at least `_CONFIRMED`, and contradicts it if its
# support is at most `_TORN`.
_CONFIRMED = 0.8
_TORN = 0.3
_MIN_MISS_DISTANCE = 4.0  # of a miss, in units of the ``max_error`` of `check_pairs`
#: A model is bent if its agreement is less than this (`agreement_of`). That of right models is 0.99
#: or more, and 0.94 in a room whose carpet repeats; of three bent ones, it is 0.61 to 0.79.
CONSISTENT = 0.93
# `agreement_of`: the share of the pairs that is considered, and their least number. A pair whose
# matches agree by `_AGREES` is right.
_WORST, _MIN_WORST = 0.05, 3
_AGREES = 0.98
_MAX_TRIALS = 3000  # most samples of RANSAC for the best relative pose of a pair


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


def agreement_of(pairs: Sequence[CheckedPair], possible: Callable[[CheckedPair], float]) -> float:
    """How well the poses agree with the matches where they agree least: 0 to 1.

    The strongest pair of each photo counts: its matches are rarely false. Where a model is bent, or
    where parts of different scales meet, many of these matches do not agree with the poses, but
    with other ones, and their features observe no point. On repeating structures, some agree with
    no poses, or with false ones: these are misses. So the number of matches that agree is divided
    by the number that the best relative pose of the pair reaches, without the misses. The result is
    the mean of the pairs with the least quotients (`_WORST`, at least `_MIN_WORST` pairs): a model
    of many photos may be bent in one place.

    ``possible``: the share of the matches of a pair that agree with the best relative pose.
    """
    strongest: dict[int, CheckedPair] = {}
    for pair in pairs:
        for photo in (pair.first, pair.second):
            if photo not in strongest or pair.weight > strongest[photo].weight:
                strongest[photo] = pair
    chosen = {(pair.first, pair.second): pair for pair in strongest.values()}.values()

    def share(pair: CheckedPair) -> float:
        if pair.agreeing >= _AGREES * (1 - pair.miss_share):
            return 1.0
        return min(1.0, pair.agreeing / max(1e-9, min(possible(pair), 1 - pair.miss_share)))

    shares = sorted(((share(pair), pair) for pair in chosen), key=lambda entry: entry[0])
    worst = shares[: max(_MIN_WORST, round(_WORST * len(shares)))]
    total = sum(pair.matches for _, pair in worst)
    return sum(share * pair.matches for share, pair in worst) / total if total else 0.0


def agreement_of_model(
    model: pycolmap.Reconstruction,
    database: Path,
    max_error: float,
    pairs: Sequence[CheckedPair] | None = None,
) -> float:
    """`agreement_of` the ``pairs`` of ``model``: the result of `check_pairs`, with the same
    ``max_error``. None: they are checked here."""
    options = pycolmap.RANSACOptions()
    options.max_error, options.max_num_trials = max_error, _MAX_TRIALS
    options.random_seed = SEED
    with closing_database(database) as source:

        def possible(pair: CheckedPair) -> float:
            ids = pair.first, pair.second
            one, two = (model.camera(model.image(i).camera_id) for i in ids)
            if any(is_fisheye(c.model_name) or c.is_spherical() for c in (one, two)):
                return 1.0  # COLMAP estimates their relative poses in the image plane
            rows = source.read_two_view_geometry(*ids).inlier_matches
            first, second = (
                source.read_keypoints(i)[rows[:, k], :2].astype(np.float64)
                for k, i in enumerate(ids)
            )
            found = pycolmap.estimate_essential_matrix(first, second, one, two, options)
            if found is None:
                return 1.0
            error = max_error / float(np.mean([pixels_per_radian(c) for c in (one, two)]))
            rays = rays_of(one, first), rays_of(two, second)
            return agreement(found["cam2_from_cam1"], *rays, error)

        checked = check_pairs(model, database, max_error) if pairs is None else pairs
        return agreement_of(checked, possible)


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
    rays: dict[int, Floats] = {}
    checked = []
    with closing_database(database) as source:
        names = database_names(source)
        follow = following_pairs(names)

        def matched_rays(image_id: int, features: Ints) -> Floats:
            if image_id not in rays:
                camera = model.camera(model.image(image_id).camera_id)
                pixels = source.read_keypoints(image_id)[:, :2].astype(np.float64)
                rays[image_id] = rays_of(camera, pixels)
            return rays[image_id][features]

        for found in sorted(verified_pairs(database), key=lambda p: (p.first, p.second)):
            first, second = found.first, found.second
            if first not in placed or second not in placed:
                continue
            rows = source.read_two_view_geometry(first, second).inlier_matches
            of_first, of_second = points[first][rows[:, 0]], points[second][rows[:, 1]]
            is_hit = (of_first == of_second) & (of_first != pycolmap.INVALID_POINT3D_ID)
            images = model.image(first), model.image(second)
            focal = np.mean([pixels_per_radian(model.camera(i.camera_id)) for i in images])
            pose = images[1].cam_from_world() * images[0].cam_from_world().inverse()
            both = matched_rays(first, rows[:, 0]), matched_rays(second, rows[:, 1])
            error = max_error / float(focal)
            sides = (images[0], of_first, both[0]), (images[1], of_second, both[1])
            missed = _misses((ids, xyz), sides[0], sides[1], _MIN_MISS_DISTANCE * error)
            missed |= _misses((ids, xyz), sides[1], sides[0], _MIN_MISS_DISTANCE * error)
            checked.append(
                CheckedPair(
                    first,
                    second,
                    len(rows),
                    int(is_hit.sum()),
                    follows=(first, second) in follow,
                    agreeing=agreement(pose, *both, error),
                    miss_share=float(np.mean(missed & ~is_hit)),
                )
            )
    return _without_bridged_tears(checked, following_pairs(names, max_step=1))


def _without_bridged_tears(
    pairs: Sequence[CheckedPair], adjacent: Collection[tuple[int, int]]
) -> list[CheckedPair]:
    """``pairs``, where bridged tears do not count as photos that follow each other.

    Let three photos i, j, k follow one another directly: (i, j) and (j, k) are in ``adjacent``. If
    the pair (i, k) is a tear, but (i, j) and (j, k) are not, this tear is *bridged*: the model
    connects the two photos through the one between them, so the matches of the tear are false. This
    occurs on a floor with a repeating pattern.
    """
    by_ids = {(pair.first, pair.second): pair for pair in pairs}
    after: dict[int, list[int]] = {}  # photo -> the adjacent ones with a pair that is no tear
    for one, other in adjacent:
        link = by_ids.get((one, other))
        if link is not None and link.counts and not link.torn:
            after.setdefault(one, []).append(other)
            after.setdefault(other, []).append(one)

    def is_bridged(pair: CheckedPair) -> bool:
        between = set(after.get(pair.first, ())).intersection(after.get(pair.second, ()))
        return pair.torn and bool(between)

    return [replace(p, follows=False) if p.follows and is_bridged(p) else p for p in pairs]


def rays_of(camera: pycolmap.Camera, pixels: Floats) -> Floats:
    """The positions (N, 2) of ``pixels`` (N, 2) in the normalised image plane of a camera.

    For a fisheye lens or a panorama, unit vectors (N, 3): its pixels are angles, up to 90° or more
    to its axis, where COLMAP's are wrong. NaN where the model is not defined.
    """
    if not (is_fisheye(camera.model_name) or camera.is_spherical()):
        return np.asarray(camera.cam_from_img(pixels))
    return lens_of(camera.model_name, camera.width, camera.height, camera.params).directions(pixels)


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


def agreement(
    cam2_from_cam1: pycolmap.Rigid3d, rays1: Floats, rays2: Floats, max_error: float
) -> float:
    """Share of the matches that agree with a relative pose, whether or not they were triangulated.

    A match agrees if its Sampson distance is at most ``max_error``, and if its two rays meet in
    front of both cameras or are nearly parallel.

    Args:
        rays1, rays2: (M, 2) positions of the matched features in the normalised image planes of the
            two cameras, or (M, 3) unit vectors.
        max_error: in the unit of the normalised image plane or of the unit sphere.
    """
    rotation, translation = cam2_from_cam1.rotation.matrix(), cam2_from_cam1.translation
    return float(np.mean(distances_of_matches(rotation, translation, rays1, rays2) <= max_error))
