"""Finds photos that a model has in a wrong place, from matches that did not become points.

The mapper registers a photo if some of its matches agree with the points of the model. If two
places look alike, it may register a photo, and then all following ones, at the wrong place. The
reprojection error remains small, because the mapper drops the matches that disagree: photos that
follow each other then have thousands of verified matches and share no points. A pair whose verified
matches the model contradicts is a *tear*.

A right model has tears, too: its look-alike places have verified matches that are wrong. So a
photo is judged by all of its matches. The photos are the nodes of a graph. The demand of an edge is
the squared number of verified matches: photos taken side by side have many matches, and a few such
pairs outweigh many weak ones, which may be false. Matches of photos that follow each other count
more (`CheckedPair.weight`). The support of an edge is the part of its demand that the model
confirms. If the photos of a model can be divided into two parts such that the model confirms little
of the demand between them, the parts contradict each other (`find_parts`). To find this division is
the problem of the sparsest cut of the support relative to the demand. Its relaxation is a
generalised eigenvalue problem (Cucuringu, Koutis, Chawla, Miller and Peng, "Simple and scalable
constrained clustering: a generalized spectral method", AISTATS 2016).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.sfm.colmap.database import closing_database, verified_pairs
from snowsplat.sfm.colmap.pairs import following, numbered_series

Floats = NDArray[np.floating[Any]]
Ints = NDArray[np.integer[Any]]
# A photo of a pair, the point that each of its matched features observes, and the rays of these
# features.
_Side = tuple[pycolmap.Image, NDArray[np.uint64], Floats]

# Pairs with fewer verified matches are not evidence: random matches reach this number.
_MIN_MATCHES = 50
# A match is a hit if it became a point of both photos. It is a miss if a feature of it has a point
# that is elsewhere in the other photo. The support of a pair is the share of hits among both; in a
# right model, it is nearly 1. Matches that have no points are no evidence: far places and small
# steps of the camera give no points. If the share of hits and misses among all matches is less than
# `_EVIDENCE`, the poses decide: the support is 1 if at least the share `_AGREEING` of the matches
# agrees with them, otherwise 0.
_EVIDENCE = 0.05
_AGREEING = 0.5
# The model confirms a pair with at least this support, and contradicts it with at most `_TORN`.
_CONFIRMED = 0.8
_TORN = 0.3
# Matches of photos whose places in the series of names differ by at most `_NEXT` count `_FOLLOWING`
# times: such photos were usually taken side by side, so their matches are rarely false. In five
# captures with right poses, the model confirms all 678 pairs of this kind.
_NEXT = 2
_FOLLOWING = 20.0
_ELSEWHERE = 4.0  # least distance of a miss, in units of the ``max_error`` of `check_pairs`
_MIN_ANGLE = 2.0  # degrees: two rays with a smaller angle between them count as parallel
# Two parts are cut apart if at most this share of the demand between them is confirmed …
_MAX_SUPPORT = 0.5
# … and at least this many pairs between them are tears. They are not cut apart if the same number
# of confirmed pairs between them has at least as many matches: photos taken side by side have more
# matches than look-alikes.
_MIN_TEARS = 3
_MIN_FOLLOWING_TEARS = 2  # the same if only pairs of photos that follow each other are counted
_VECTORS = 6  # eigenvectors that are tried for a cut
_THRESHOLDS = 10  # thresholds that are tried for each of them


@dataclass(frozen=True)
class CheckedPair:
    """Two photos with a pose and verified matches, and what became of these matches.

    ``first`` and ``second`` are image ids of the database, ``first`` < ``second``.
    """

    first: int
    second: int
    matches: int  # verified matches
    shared: int  # matches whose two features observe the same point of the model
    agreeing: float = 0.0  # share of the matches that agree with the poses, if computed
    missing: float = 0.0  # share of misses, if computed
    follows: bool = False  # the photos follow each other by name, at most `_NEXT` apart

    @property
    def weight(self) -> float:
        """The number of matches, as evidence: those of photos that follow each other count more."""
        return self.matches * (_FOLLOWING if self.follows else 1.0)

    @property
    def share(self) -> float:
        """The share of the verified matches that became points."""
        return self.shared / self.matches

    @property
    def support(self) -> float:
        """How far the model confirms the matches: 0 (it contradicts them) … 1."""
        hits, misses = self.share, self.missing
        if hits + misses >= _EVIDENCE:
            return hits / (hits + misses)
        return float(self.agreeing >= _AGREEING)

    @property
    def torn(self) -> bool:
        """Whether the model contradicts the matches."""
        return self.matches >= _MIN_MATCHES and self.support <= _TORN


def check_pairs(
    model: pycolmap.Reconstruction, database: Path, max_error: float
) -> list[CheckedPair]:
    """Compare each verified pair of photos in ``model`` with the poses and points of the model.

    ``max_error`` in pixels is the largest distance of a verified match from its epipolar line.
    """
    placed = set(model.reg_image_ids())
    points = {image_id: _point_ids(model.image(image_id)) for image_id in placed}
    positions = _Positions.of(model)
    rays: dict[int, Floats] = {}
    checked = []
    with closing_database(database) as source:
        in_order = _pairs_in_order(source)

        def rays_of(image_id: int, features: Ints) -> Floats:
            if image_id not in rays:
                camera = model.camera(model.image(image_id).camera_id)
                pixels = source.read_keypoints(image_id)[:, :2].astype(np.float64)
                rays[image_id] = np.asarray(camera.cam_from_img(pixels))
            return rays[image_id][features]

        for found in sorted(verified_pairs(database), key=lambda p: (p.first, p.second)):
            first, second = found.first + 1, found.second + 1
            if first not in placed or second not in placed:
                continue
            rows = source.read_two_view_geometry(first, second).inlier_matches
            of_first, of_second = points[first][rows[:, 0]], points[second][rows[:, 1]]
            is_shared = (of_first == of_second) & (of_first != pycolmap.INVALID_POINT3D_ID)
            follows = (first, second) in in_order
            pair = CheckedPair(first, second, len(rows), int(is_shared.sum()), follows=follows)
            if len(rows) >= _MIN_MATCHES:
                images = model.image(first), model.image(second)
                focal = np.mean([model.camera(i.camera_id).mean_focal_length() for i in images])
                pose = images[1].cam_from_world() * images[0].cam_from_world().inverse()
                both = rays_of(first, rows[:, 0]), rays_of(second, rows[:, 1])
                error = max_error / float(focal)
                sides = (images[0], of_first, both[0]), (images[1], of_second, both[1])
                missed = _misses(positions, sides[0], sides[1], _ELSEWHERE * error)
                missed |= _misses(positions, sides[1], sides[0], _ELSEWHERE * error)
                pair = replace(
                    pair,
                    agreeing=agreement(pose, *both, error),
                    missing=float(np.mean(missed & ~is_shared)),
                )
            checked.append(pair)
    return checked


def _pairs_in_order(database: pycolmap.Database) -> set[tuple[int, int]]:
    """The image ids (first < second) of the pairs of photos that follow each other by name."""
    names = {image.image_id: image.name for image in database.read_all_images()}
    steps = range(1, _NEXT + 1)
    return set().union(*(following(series, steps) for series in numbered_series(names)))


def _point_ids(image: pycolmap.Image) -> NDArray[np.uint64]:
    """(features,) the id of the point that each feature observes, or the invalid id."""
    points = image.points2D
    ids = np.full(len(points), pycolmap.INVALID_POINT3D_ID, np.uint64)
    for row in image.get_observation_point2D_idxs():
        ids[row] = points[row].point3D_id
    return ids


@dataclass(frozen=True)
class _Positions:
    """The positions of all points of a model."""

    ids: NDArray[np.uint64]  # (P,) ascending
    xyz: Floats  # (P, 3)

    @staticmethod
    def of(model: pycolmap.Reconstruction) -> _Positions:
        ids = np.array(sorted(model.points3D), np.uint64)
        xyz = np.array([model.point3D(int(i)).xyz for i in ids]).reshape(-1, 3)
        return _Positions(ids, xyz)

    def __getitem__(self, ids: NDArray[np.uint64]) -> Floats:
        return self.xyz[np.searchsorted(self.ids, ids)]


def _misses(positions: _Positions, one: _Side, other: _Side, max_error: float) -> NDArray[np.bool_]:
    """(M,) whether the feature of ``one`` has a point that is elsewhere in the photo of ``other``.

    ``max_error``: the largest distance from the matched feature in the normalised image plane.
    """
    _, ids, _ = one
    image, _, rays = other
    missed = np.zeros(len(ids), bool)
    rows = np.flatnonzero(ids != pycolmap.INVALID_POINT3D_ID)
    if len(rows):
        points = positions[ids[rows]]
        camera = image.cam_from_world().matrix()
        seen = points @ camera[:, :3].T + camera[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.linalg.norm(seen[:, :2] / seen[:, 2:] - rays[rows], axis=1)
        missed[rows] = (seen[:, 2] <= 0) | (distance > max_error)
    return missed


def agreement(
    cam2_from_cam1: pycolmap.Rigid3d, rays1: Floats, rays2: Floats, max_error: float
) -> float:
    """Share of the matches that agree with a relative pose, whether or not they became points.

    Such a match is on its epipolar line, and its rays meet in front of both cameras or are nearly
    parallel. ``rays1`` and ``rays2``: (M, 2) the matched features in the normalised image planes of
    the two cameras. ``max_error``: the largest Sampson distance, in the same unit.
    """
    rotation, translation = cam2_from_cam1.rotation.matrix(), cam2_from_cam1.translation
    x, y, z = translation
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    one, two = (np.concatenate([rays, np.ones((len(rays), 1))], 1) for rays in (rays1, rays2))
    lines1, lines2 = two @ essential, one @ essential.T
    length = (lines1[:, :2] ** 2).sum(1) + (lines2[:, :2] ** 2).sum(1)
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


def find_parts(pairs: Sequence[CheckedPair]) -> list[set[int]]:
    """The parts of a model that contradict each other: sets of image ids.

    The first part is the largest one, with all photos that do not contradict it; so a model without
    contradictions is one part. Photos without evidence are in no part.
    """
    pairs = [pair for pair in pairs if pair.matches >= _MIN_MATCHES]
    ids = sorted({i for pair in pairs for i in (pair.first, pair.second)})
    if not ids:
        return []
    index = {image_id: row for row, image_id in enumerate(ids)}
    demand = np.zeros((len(ids), len(ids)))
    support, torn, confirmed = demand.copy(), demand.copy(), demand.copy()
    follows = np.zeros(demand.shape, bool)
    for pair in pairs:
        i, j = index[pair.first], index[pair.second]
        demand[i, j] = demand[j, i] = pair.weight**2
        support[i, j] = support[j, i] = pair.weight**2 * pair.support
        torn[i, j] = torn[j, i] = pair.weight * pair.torn
        confirmed[i, j] = confirmed[j, i] = pair.weight * (pair.support >= _CONFIRMED)
        follows[i, j] = follows[j, i] = pair.follows
    graph = _Graph(demand, support, torn, confirmed, follows)
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
    """Symmetric (N, N) matrices without diagonal."""

    demand: Floats  # the squared `CheckedPair.weight`
    support: Floats  # the confirmed part of the demand
    torn: Floats  # the weight of tears, 0 for other pairs
    confirmed: Floats  # the weight of confirmed pairs (`_CONFIRMED`), 0 for other pairs
    follows: NDArray[np.bool_]  # whether the photos follow each other

    def contradicts(self, one: Sequence[int], other: Sequence[int]) -> bool:
        """Whether the model contradicts the matches between two sets of photos."""
        return self.contradiction(one, other) is not None

    def contradiction(self, one: Sequence[int], other: Sequence[int]) -> float | None:
        """The confirmed share of the demand between two sets of photos; None: no contradiction.

        The pairs of photos that follow each other suffice for a contradiction, whatever the other
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
        torn = _strongest(self.torn[across] * pairs, tears)
        if torn <= _strongest(self.confirmed[across] * pairs, tears):
            return None
        share = float((self.support[across] * pairs).sum() / (self.demand[across] * pairs).sum())
        return share if share <= _MAX_SUPPORT else None


def _strongest(matches: Floats, count: int) -> float:
    """The ``count``-th largest of the entries; 0 if there are fewer."""
    ordered = np.sort(matches, axis=None)
    return float(ordered[-count]) if len(ordered) >= count else 0.0


def _components(linked: NDArray[np.bool_]) -> list[list[int]]:
    """The connected components of a symmetric (N, N) matrix of links: sorted rows."""
    left = set(range(len(linked)))
    components = []
    while left:
        found, new = set(), {min(left)}
        while new:
            found |= new
            new = set(np.flatnonzero(linked[sorted(new)].any(0)).tolist()) - found
        components.append(sorted(found))
        left -= found
    return components


def _split(graph: _Graph, photos: list[int]) -> Iterator[list[int]]:
    """Cut the photos until no part contradicts itself."""
    best = None
    for one in itertools.chain(_grown(graph, photos), _cuts(graph, photos)):
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


def _grown(graph: _Graph, photos: list[int]) -> Iterator[list[int]]:
    """Candidates for one side of a cut: groups grown along the confirmed pairs, strongest first.

    Pairs of photos that follow each other come before all others. Groups that contradict each other
    are not joined. This finds parts that the eigenvectors (`_cuts`) miss: those that many pairs
    link to the rest.
    """
    group = {photo: [photo] for photo in photos}
    apart: set[tuple[int, int, int, int]] = set()
    rows, columns = np.nonzero(np.triu(graph.support[np.ix_(photos, photos)]))
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


def _cuts(graph: _Graph, photos: list[int]) -> Iterator[list[int]]:
    """Candidates for one side of the sparsest cut of ``photos``: sweeps over eigenvectors."""
    count = len(photos)
    if count < 2:
        return
    rows = np.ix_(photos, photos)
    demand, support = graph.demand[rows], graph.support[rows]
    scale = demand.sum() / count
    ones = np.ones((count, count)) / count
    # The constant vector solves the problem with the value 0; the second term makes its value 2,
    # greater than all others, which are between 0 and 1.
    above = _laplacian(support) / scale + 2 * ones
    below = _laplacian(demand) / scale + ones
    inverse = np.linalg.inv(np.linalg.cholesky(below))
    vectors = inverse.T @ np.linalg.eigh(inverse @ above @ inverse.T)[1][:, :_VECTORS]
    for vector in vectors.T:
        order = np.argsort(vector, kind="stable")
        across_demand = _cut_weights(demand, order)
        across_support = _cut_weights(support, order)
        ratio = across_support / np.maximum(across_demand, 1e-300)
        torn = _cut_weights((graph.torn[rows] > 0).astype(float), order)
        ratio[torn < _MIN_TEARS] = np.inf
        for size in np.argsort(ratio, kind="stable")[:_THRESHOLDS] + 1:
            if ratio[size - 1] <= _MAX_SUPPORT:
                yield sorted(photos[i] for i in order[:size])


def _laplacian(weights: Floats) -> Floats:
    return np.diag(weights.sum(1)) - weights


def _cut_weights(weights: Floats, order: Ints) -> Floats:
    """(N − 1,) weight between the first k and the other photos of ``order``, for each k."""
    sorted_weights = weights[np.ix_(order, order)]
    # Photo k leaves the other side: its links to the first ones are no longer cut, the others are.
    before = np.tril(sorted_weights).sum(1)
    return np.cumsum(sorted_weights.sum(1) - 2 * before)[:-1]


def _merged(graph: _Graph, parts: list[list[int]]) -> list[list[int]]:
    """Join parts that the model confirms to belong together, the most strongly linked first."""
    parts = [sorted(part) for part in parts]
    while True:
        best = None
        for i, one in enumerate(parts):
            for j, other in enumerate(parts[:i]):
                across = np.ix_(one, other)
                support = graph.support[across].sum()
                linked = support > 0 and not graph.contradicts(one, other)
                if linked and (best is None or support > best[0]):
                    best = support, i, j
        if best is None:
            return parts
        _, i, j = best
        parts[j] = sorted(parts[j] + parts.pop(i))
