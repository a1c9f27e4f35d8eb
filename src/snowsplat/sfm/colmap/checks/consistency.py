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

Two parts of the photos contradict each other if only a small share of the demand between them is
supported (`find_parts`). The best division is the sparsest cut of the graph: the cut with the least
ratio of supported demand to demand. This problem is relaxed to a generalised eigenvalue problem
(Cucuringu, Koutis, Chawla, Miller and Peng, "Simple and scalable constrained clustering: a
generalized spectral method", AISTATS 2016).
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.data.lens.models import lens_of
from snowsplat.sfm.colmap.database import closing_database, verified_pairs
from snowsplat.sfm.colmap.features.extraction import SEED
from snowsplat.sfm.colmap.lenses.lens import is_fisheye, pixels_per_radian
from snowsplat.sfm.colmap.mapping.view_graph import VerifiedPair, database_names, following_pairs
from snowsplat.util.components import components

Floats = NDArray[np.floating[Any]]
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
_MIN_ANGLE = 2.0  # degrees: two rays with a smaller angle between them count as parallel
# Two parts contradict each other if both of these conditions hold:
# - At most the share `_MAX_SUPPORT` of the demand between them is supported.
# - Let n be `_MIN_TEARS`, or `_MIN_FOLLOWING_TEARS` if only the pairs of photos that follow each
#   other are examined. Sort the tears between the parts by weight, the largest first, and the
#   confirmed pairs, too. The n-th tear has a larger weight than the n-th confirmed pair, if there
#   is one. (Photos taken side by side have more matches than photos of places that look alike.)
_MAX_SUPPORT = 0.5
_MIN_TEARS = 3
_MIN_FOLLOWING_TEARS = 2
#: A model is bent if its agreement is less than this (`agreement_of`). That of right models is 0.99
#: or more, and 0.94 in a room whose carpet repeats; of three bent ones, it is 0.61 to 0.79.
CONSISTENT = 0.93
# `agreement_of`: the share of the pairs that is considered, and their least number. A pair whose
# matches agree by `_AGREES` is right.
_WORST, _MIN_WORST = 0.05, 3
_AGREES = 0.98
_MAX_TRIALS = 3000  # most samples of RANSAC for the best relative pose of a pair
_VECTORS = 6  # number of eigenvectors that are tried
_THRESHOLDS = 10  # number of thresholds that are tried for each eigenvector


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
            rays = _rays(one, first), _rays(two, second)
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

        def rays_of(image_id: int, features: Ints) -> Floats:
            if image_id not in rays:
                camera = model.camera(model.image(image_id).camera_id)
                pixels = source.read_keypoints(image_id)[:, :2].astype(np.float64)
                rays[image_id] = _rays(camera, pixels)
            return rays[image_id][features]

        for found in sorted(verified_pairs(database), key=lambda p: (p.first, p.second)):
            first, second = found.first + 1, found.second + 1
            if first not in placed or second not in placed:
                continue
            rows = source.read_two_view_geometry(first, second).inlier_matches
            of_first, of_second = points[first][rows[:, 0]], points[second][rows[:, 1]]
            is_hit = (of_first == of_second) & (of_first != pycolmap.INVALID_POINT3D_ID)
            images = model.image(first), model.image(second)
            focal = np.mean([pixels_per_radian(model.camera(i.camera_id)) for i in images])
            pose = images[1].cam_from_world() * images[0].cam_from_world().inverse()
            both = rays_of(first, rows[:, 0]), rays_of(second, rows[:, 1])
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


def unconfirmed_photos(pairs: Sequence[CheckedPair]) -> set[int]:
    """The photos (image ids) whose pose is doubtful, although no part contradicts another one.

    Such a photo has at least `_MIN_TEARS` tears, but no pair that the model confirms. In a correct
    model, every photo is confirmed by others, even if most of its matches are false.
    """
    tears: Counter[int] = Counter()
    confirmed: set[int] = set()
    for pair in pairs:
        tears.update({pair.first: int(pair.torn), pair.second: int(pair.torn)})
        if pair.counts and pair.support >= _CONFIRMED:
            confirmed |= {pair.first, pair.second}
    return {photo for photo, count in tears.items() if count >= _MIN_TEARS} - confirmed


def _rays(camera: pycolmap.Camera, pixels: Floats) -> Floats:
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
    x, y, z = translation
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    one, two = (_homogeneous(rays) for rays in (rays1, rays2))
    lines1, lines2 = two @ essential, one @ essential.T
    # The squared gradient of the product below, along the image plane or the sphere. There, the
    # part across the sphere is zero on the epipolar line, and small near it.
    length = (lines1[:, : rays1.shape[1]] ** 2).sum(1) + (lines2[:, : rays2.shape[1]] ** 2).sum(1)
    distance = np.abs((two * lines2).sum(1)) / np.sqrt(np.maximum(length, 1e-300))
    # depth1 · one + translation ≈ depth2 · two, with both rays in the frame of the second camera.
    one = one @ rotation.T
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    two /= np.linalg.norm(two, axis=1, keepdims=True)
    cosine = (one * two).sum(1)
    along1, along2 = one @ translation, two @ translation
    is_in_front = (cosine * along2 > along1) & (along2 > cosine * along1)
    is_parallel = cosine > np.cos(np.radians(_MIN_ANGLE))
    return float(np.mean((distance <= max_error) & (is_in_front | is_parallel)))


def _homogeneous(rays: Floats) -> Floats:
    """(M, 3): ``rays``, with z = 1 if they are in an image plane."""
    return rays.copy() if rays.shape[1] == 3 else np.pad(rays, ((0, 0), (0, 1)), constant_values=1)


def find_parts(pairs: Sequence[CheckedPair]) -> list[set[int]]:
    """The parts of a model that contradict each other: sets of image ids.

    The first set contains the photos of the largest part, and of all parts that do not contradict
    it. Each of the other parts is one set. So there is only one set for a model without
    contradictions. Photos without a pair that counts are in no set.
    """
    pairs = [pair for pair in pairs if pair.counts]
    ids = sorted({i for pair in pairs for i in (pair.first, pair.second)})
    if not ids:
        return []
    index = {image_id: row for row, image_id in enumerate(ids)}
    demand = np.zeros((len(ids), len(ids)))
    supported, torn, confirmed = demand.copy(), demand.copy(), demand.copy()
    follows = np.zeros(demand.shape, bool)
    for pair in pairs:
        i, j = index[pair.first], index[pair.second]
        demand[i, j] = demand[j, i] = pair.weight**2
        supported[i, j] = supported[j, i] = pair.weight**2 * pair.support
        torn[i, j] = torn[j, i] = pair.weight * pair.torn
        confirmed[i, j] = confirmed[j, i] = pair.weight * (pair.support >= _CONFIRMED)
        follows[i, j] = follows[j, i] = pair.follows
    graph = _Graph(demand, supported, torn, confirmed, follows)
    parts = [part for component in _components(demand > 0) for part in _split(graph, component)]
    parts = sorted(_merged(graph, parts), key=lambda part: (-len(part), part[0]))
    kept: list[int] = []
    cut = []
    for part in parts:
        if kept and graph.contradicts(part, kept):
            cut.append(part)
        else:
            kept += part
    return [{ids[row] for row in part} for part in [kept, *cut]]


@dataclass(frozen=True)
class _Graph:
    """The pairs of N photos as symmetric (N, N) matrices; the diagonals are zero."""

    demand: Floats  # the squared `CheckedPair.weight`
    supported: Floats  # the demand multiplied by `CheckedPair.support`
    torn: Floats  # `CheckedPair.weight` of tears, 0 for other pairs
    confirmed: Floats  # `CheckedPair.weight` of confirmed pairs (`_CONFIRMED`), 0 for other pairs
    follows: NDArray[np.bool_]  # whether the photos follow each other

    def contradicts(self, one: Sequence[int], other: Sequence[int]) -> bool:
        """Whether the model contradicts the matches between two sets of photos."""
        return self.contradiction(one, other) is not None

    def contradiction(self, one: Sequence[int], other: Sequence[int]) -> float | None:
        """The supported share of the demand between two sets of photos that contradict each other.

        None if they do not. Pairs of photos that follow each other are also examined on their own.
        If these pairs contradict the model, the sets contradict each other, whatever the other
        pairs show: if two whole rooms look alike, hundreds of false pairs agree with each other.
        """
        across = np.ix_(one, other)
        follows = self.follows[across]
        shares = [self._contradiction(across, _MIN_TEARS, np.ones_like(follows))]
        if follows.any():
            shares.append(self._contradiction(across, _MIN_FOLLOWING_TEARS, follows))
        return min((share for share in shares if share is not None), default=None)

    def _contradiction(
        self, across: tuple[Ints, ...], tears: int, pairs: NDArray[np.bool_]
    ) -> float | None:
        torn = _nth_largest(self.torn[across] * pairs, tears)
        if torn <= _nth_largest(self.confirmed[across] * pairs, tears):
            return None
        share = float((self.supported[across] * pairs).sum() / (self.demand[across] * pairs).sum())
        return share if share <= _MAX_SUPPORT else None


def _nth_largest(values: Floats, n: int) -> float:
    """The ``n``-th largest entry; 0 if there are fewer entries."""
    ordered = np.sort(values, axis=None)
    return float(ordered[-n]) if len(ordered) >= n else 0.0


def _components(linked: NDArray[np.bool_]) -> list[list[int]]:
    """The connected components of a graph of N nodes, as sorted lists of nodes. ``linked``: (N, N)
    symmetric, whether two nodes have an edge."""
    first, second = np.nonzero(linked)
    label = components((first, second), len(linked))
    return [np.flatnonzero(label == node).tolist() for node in np.unique(label)]


def _split(graph: _Graph, photos: list[int]) -> Iterator[list[int]]:
    """Divide photos into parts, until no part can be divided into two that contradict each other.
    Of all candidates, the division with the smallest supported share of the demand is used."""
    best = None
    for one in itertools.chain(_grown_groups(graph, photos), _sweep_cuts(graph, photos)):
        inside = set(one)
        other = [i for i in photos if i not in inside]
        share = graph.contradiction(one, other)
        if share is not None and (best is None or share < best[0]):
            best = share, one, other
    if best is None:
        yield photos
        return
    for part in best[1:]:
        for component in _components(graph.demand[np.ix_(part, part)] > 0):
            yield from _split(graph, [part[i] for i in component])


def _grown_groups(graph: _Graph, photos: list[int]) -> Iterator[list[int]]:
    """Candidates for one side of a cut: groups of photos that are linked by pairs with support.

    Each photo starts as a group. The pairs of photos that follow each other are processed first,
    then all other pairs; both in the order of `_Graph.confirmed`, the largest value first. Each
    pair joins the groups of its two photos, unless these groups contradict each other. This finds
    parts that `_sweep_cuts` does not find: those that have many pairs with the rest of the photos.
    """
    group = {photo: [photo] for photo in photos}
    apart: set[tuple[int, int, int, int]] = set()
    rows, columns = np.nonzero(np.triu(graph.supported[np.ix_(photos, photos)]))
    edges = np.take(photos, rows), np.take(photos, columns)
    for edge in np.lexsort((-graph.confirmed[edges], ~graph.follows[edges])):
        one, other = group[photos[rows[edge]]], group[photos[columns[edge]]]
        key = (one[0], len(one), other[0], len(other))
        if one is other or key in apart:
            continue
        if graph.contradicts(one, other):
            apart.add(key)
            continue
        one += other
        for photo in other:
            group[photo] = one
    groups = {id(members): members for members in group.values()}
    if len(groups) > 1:
        yield from (sorted(members) for members in groups.values())


def _sweep_cuts(graph: _Graph, photos: list[int]) -> Iterator[list[int]]:
    """Candidates for one side of the sparsest cut of ``photos``: sweep cuts of eigenvectors.

    The photos are sorted by their entries in an eigenvector. The first k photos in this order, for
    any k, can be one side of a cut. The `_THRESHOLDS` cuts with the least ratio of supported demand
    to demand are tried.
    """
    count = len(photos)
    if count < 2:
        return
    rows = np.ix_(photos, photos)
    demand, supported = graph.demand[rows], graph.supported[rows]
    scale = demand.sum() / count
    ones = np.ones((count, count)) / count
    # The eigenvalue problem is L(supported) v = λ L(demand) v, where L is the Laplacian. A constant
    # v is a useless solution. Adding `ones` to L(demand) makes this matrix invertible. Adding twice
    # `ones` to L(supported) gives the constant v the eigenvalue 2; all others are between 0 and 1.
    above = _laplacian(supported) / scale + 2 * ones
    below = _laplacian(demand) / scale + ones
    inverse = np.linalg.inv(np.linalg.cholesky(below))
    vectors = inverse.T @ np.linalg.eigh(inverse @ above @ inverse.T)[1][:, :_VECTORS]
    for vector in vectors.T:
        order = np.argsort(vector, kind="stable")
        across_demand = _cut_weights(demand, order)
        across_supported = _cut_weights(supported, order)
        ratio = across_supported / np.maximum(across_demand, 1e-300)
        torn = _cut_weights((graph.torn[rows] > 0).astype(float), order)
        ratio[torn < _MIN_TEARS] = np.inf
        for size in np.argsort(ratio, kind="stable")[:_THRESHOLDS] + 1:
            if ratio[size - 1] <= _MAX_SUPPORT:
                yield sorted(photos[i] for i in order[:size])


def _laplacian(weights: Floats) -> Floats:
    return np.diag(weights.sum(1)) - weights


def _cut_weights(weights: Floats, order: Ints) -> Floats:
    """(N − 1,) the sum of the weights between the first k photos of ``order`` and the other photos.
    The entries are those for k = 1, …, N − 1."""
    sorted_weights = weights[np.ix_(order, order)]
    # When photo k joins the first photos, its edges to them are not cut any more, and its edges to
    # the other photos are cut.
    before = np.tril(sorted_weights).sum(1)
    return np.cumsum(sorted_weights.sum(1) - 2 * before)[:-1]


def _merged(graph: _Graph, parts: list[list[int]]) -> list[list[int]]:
    """Join parts that have supported demand between them and do not contradict each other. The two
    parts with the largest supported demand between them are joined first."""
    parts = [sorted(part) for part in parts]
    while True:
        best = None
        for i, one in enumerate(parts):
            for j, other in enumerate(parts[:i]):
                across = np.ix_(one, other)
                supported = graph.supported[across].sum()
                linked = supported > 0 and not graph.contradicts(one, other)
                if linked and (best is None or supported > best[0]):
                    best = supported, i, j
        if best is None:
            return parts
        _, i, j = best
        parts[j] = sorted(parts[j] + parts.pop(i))
