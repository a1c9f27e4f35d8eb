"""`PhotoSample`: small copies of some photos of a dataset, spread over it, some of them close."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from snowsplat.data.dataset import View
from snowsplat.data.judge.rig import Rig
from snowsplat.data.photos.decode import load_thumbnail
from snowsplat.util.errors import UserError

# Pixels of the longer side: enough for matches, and for the colours of points.
SIDE = 320
# Views spread over the dataset in the order of names. Each brings two neighbours: the next one by
# name, and the nearest one by pose. If the poses are right, these see the same things.
_ANCHORS = 8
# Views whose pose may be wrong that are added: those with the pose of another one, and those far
# from between their neighbours by name, in position or direction; and the views around each.
_REPEATED, _ASTRAY, _AROUND = 4, 4, 2
# How many times the distance between the neighbours the way over a view is, to be astray.
_DETOUR = 3.0


@dataclass(frozen=True)
class PhotoSample:
    """Some views of a dataset.

    Attributes:
        views: their indices in the dataset.
        groups: (N,) the number of the anchor that a view belongs to; views of one group may look
            alike.
        near: pairs of views of the sample, one of which may have a wrong pose.
        photos: (4, h, w) uint8 RGBA each. Masks are not applied: what is moving in a few photos
            misleads no witness, and a mask may be wrong.
    """

    views: list[int]
    groups: np.ndarray
    near: set[tuple[int, int]]
    photos: list[np.ndarray]

    @classmethod
    def of(cls, views: Sequence[View], rig: Rig) -> PhotoSample:
        """Decode a sample of the photos. Photos that cannot be decoded are left out."""
        group, near = _choose_views(rig)
        workers = min(4, os.cpu_count() or 1)
        with ThreadPoolExecutor(workers, thread_name_prefix="snowsplat-judge") as pool:
            decoded = list(pool.map(lambda i: _photo(views[i]), group))
        kept = {i: photo for i, photo in zip(group, decoded, strict=True) if photo is not None}
        place = {view: number for number, view in enumerate(kept)}
        pairs = {(place[a], place[b]) for a, b in near if a in place and b in place}
        return cls(list(kept), np.array([group[i] for i in kept]), pairs, list(kept.values()))

    def __len__(self) -> int:
        return len(self.views)


def _choose_views(rig: Rig) -> tuple[dict[int, int], set[tuple[int, int]]]:
    """The group of each view of the sample, by its index; sorted. Pairs of views as in ``near``."""
    count = len(rig)
    anchors = np.unique(np.linspace(0, count - 1, min(count, _ANCHORS)).round().astype(int))
    positions = rig.positions
    group = {int(anchor): number for number, anchor in enumerate(anchors)}
    for number, anchor in enumerate(anchors):
        distance = np.linalg.norm(positions - positions[anchor], axis=1)
        distance[distance == 0] = np.inf
        for neighbour in (min(anchor + 1, count - 1), distance.argmin()):
            group.setdefault(int(neighbour), number)
    near: set[tuple[int, int]] = set()
    for number, view in enumerate(_suspects(rig), len(anchors)):
        around = range(max(0, view - _AROUND), min(count, view + _AROUND + 1))
        for other in around:
            group.setdefault(other, number)
        near |= {(min(view, other), max(view, other)) for other in around if other != view}
    return dict(sorted(group.items())), near


def _suspects(rig: Rig) -> list[int]:
    """Views whose pose may be wrong. Trackers that were lost repeat a pose, or jump."""
    count, positions = len(rig), rig.positions
    poses = np.concatenate([rig.rotation.reshape(count, 9), rig.translation], 1)
    _, which, often = np.unique(poses, axis=0, return_inverse=True, return_counts=True)
    repeated = np.flatnonzero(often[which.reshape(-1)] > 1)[:_REPEATED]
    if count < 3:
        return repeated.tolist()
    detour = np.maximum(_detours(positions), _detours(rig.rotation.reshape(count, 9)))
    astray = 1 + np.argsort(-detour, kind="stable")[:_ASTRAY]
    return [*repeated.tolist(), *(int(i) for i in astray if detour[i - 1] > _DETOUR)]


def _detours(values: np.ndarray) -> np.ndarray:
    """(N − 2,): how much longer the way over a row (N, D) is than that between its neighbours."""
    steps = np.linalg.norm(np.diff(values, axis=0), axis=1)
    ends = np.linalg.norm(values[2:] - values[:-2], axis=1)
    return (steps[:-1] + steps[1:]) / np.maximum(ends, max(np.median(steps), 1e-30))


def _photo(view: View) -> np.ndarray | None:
    try:
        return load_thumbnail(view.image, SIDE)
    except UserError:  # the training says so, or leaves the photo out
        return None
