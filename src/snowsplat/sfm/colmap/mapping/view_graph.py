"""The view graph: its nodes are the photos, its edges the pairs with verified matches.

`spread_subset` chooses the photos from which a model is made first.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.sfm.colmap.database import VerifiedPair, closing_database, verified_pairs
from snowsplat.sfm.colmap.pairs.choice import numbered_series, pairs_following
from snowsplat.util.components import components

# Two photos follow each other if their positions in a series of names (`numbered_series`) differ by
# at most this number.
_MAX_STEP = 2
_STRONG_PAIR = 100  # number of verified matches of a strong pair
# Two photos of the subset that follow each other by name are at most this number of positions apart
# in the series of all photos. Even photos of equal rooms can be a strong pair.
_MAX_GAP = 4


@dataclass(frozen=True)
class ViewGraph:
    """The verified pairs of some photos."""

    names: Mapping[int, str]  # image id -> file name, of all photos of the graph
    pairs_of: Mapping[int, list[VerifiedPair]]  # image id -> its pairs

    @staticmethod
    def from_pairs(names: Mapping[int, str], pairs: Iterable[VerifiedPair]) -> ViewGraph:
        """Pairs with a photo that is not in ``names`` are left out."""
        follow = following_pairs(names)
        pairs_of: dict[int, list[VerifiedPair]] = {i: [] for i in names}
        for found in pairs:
            if found.first in names and found.second in names:
                pair = replace(found, follows=(found.first, found.second) in follow)
                pairs_of[pair.first].append(pair)
                pairs_of[pair.second].append(pair)
        return ViewGraph(names, pairs_of)

    @staticmethod
    def read(database: Path) -> ViewGraph:
        """The graph of all photos and verified pairs in the database."""
        with closing_database(database) as source:
            names = database_names(source)
        return ViewGraph.from_pairs(names, verified_pairs(database))

    @property
    def pairs(self) -> list[VerifiedPair]:
        """All pairs, sorted by their image ids."""
        found = (pair for i, pairs in self.pairs_of.items() for pair in pairs if pair.first == i)
        return sorted(found, key=lambda pair: (pair.first, pair.second))

    def of_photos(self, photos: Collection[int]) -> ViewGraph:
        """The graph of these photos only.

        Two photos follow each other in it if at most one of these photos is between them.
        """
        chosen = set(photos)
        names = {i: name for i, name in self.names.items() if i in chosen}
        return ViewGraph.from_pairs(names, self.pairs)

    def matrix(self) -> tuple[list[int], NDArray[np.floating[Any]]]:
        """The image ids in ascending order, and the number of verified matches of each pair.

        The numbers are a symmetric (N, N) matrix; 0: the two photos are no pair.
        """
        ids = sorted(self.names)
        row = {photo: index for index, photo in enumerate(ids)}
        matches = np.zeros((len(ids), len(ids)))
        for pair in self.pairs:
            i, j = row[pair.first], row[pair.second]
            matches[i, j] = matches[j, i] = pair.matches
        return ids, matches


def following_pairs(names: Mapping[int, str]) -> set[tuple[int, int]]:
    """The pairs (first < second) of photos that follow each other by name. ``names``: id -> name"""
    steps = range(1, _MAX_STEP + 1)
    return set().union(*(pairs_following(series, steps) for series in numbered_series(names)))


def database_names(database: pycolmap.Database) -> dict[int, str]:
    """Image id -> file name, of all photos."""
    return {image.image_id: image.name for image in database.read_all_images()}


def spread_subset(graph: ViewGraph, count: int) -> set[int]:
    """``count`` photos (image ids), or more if fewer photos can be left out.

    Photos are left out one after the other: the next one is the photo whose second strongest pair
    has the most matches. A photo is not left out if one of these conditions holds:

    - It has fewer than two strong pairs (`_STRONG_PAIR`) with the photos of the subset.
    - Strong pairs would not connect the other photos of these pairs without it.
    - It is the first or last photo of a series of names.
    - The photos before and after it by name are no strong pair, or more than `_MAX_GAP` positions
      apart. Of four photos of the subset in a row, two photos with one photo between them must be a
      strong pair, too: a photo is registered from points that two photos before it see.
    """
    ids, matches = graph.matrix()
    strong = matches >= _STRONG_PAIR
    kept = np.ones(len(ids), bool)
    row = {photo: index for index, photo in enumerate(ids)}
    before: dict[int, int | None] = {}  # row of a photo -> row of the kept photo before it by name
    after: dict[int, int | None] = {}
    position: dict[int, int] = {}  # in the series
    for series in numbered_series(graph.names):
        position |= {row[photo]: place for place, photo in enumerate(series)}
        for i, j in itertools.pairwise(series):
            after[row[i]], before[row[j]] = row[j], row[i]

    def needed(index: int) -> bool:
        if index in position:
            one, other = before.get(index), after.get(index)
            if one is None or other is None:
                return True
            links = [(one, other), (before.get(one), other), (one, after.get(other))]
            weak = any(None not in link and not strong[link] for link in links)
            if weak or position[other] - position[one] > _MAX_GAP:
                return True
        near = np.flatnonzero(strong[index])
        edges = np.nonzero(strong[np.ix_(near, near)])
        return len(near) < 2 or bool(components(edges, len(near)).any())

    # The number of matches of the second strongest pair of each photo. It is small for a photo at
    # the end of a walk, which may have one strong pair only.
    second = _second_largest(matches)
    is_needed = np.zeros(len(ids), bool)  # is computed again only if a neighbour is left out
    while kept.sum() > count:
        rows = np.flatnonzero(kept & ~is_needed)
        for index in rows[np.argsort(-second[rows], kind="stable")].tolist():
            is_needed[index] = needed(index)
            if not is_needed[index]:
                break
        else:
            break
        kept[index] = False
        one, other = before.pop(index, None), after.pop(index, None)
        if one is not None:
            after[one] = other
            is_needed[one] = False
        if other is not None:
            before[other] = one
            is_needed[other] = False
        is_needed[strong[index]] = False
        strong[index] = strong[:, index] = False
        near = np.flatnonzero(matches[index])
        matches[index] = matches[:, index] = 0
        second[near] = _second_largest(matches[near])
    return {photo for photo, keep in zip(ids, kept, strict=True) if keep}


def _second_largest(values: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """The second largest entry of each row of (N, M) values; 0 if M < 2."""
    return np.partition(values, -2)[:, -2] if values.shape[1] > 1 else np.zeros(len(values))
