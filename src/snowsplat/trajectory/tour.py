"""The order in which a path visits cameras: the order of their names, or a short tour."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.trajectory.focus import positions_of, rotations_of
from snowsplat.util.natural_order import natural_key

#: If there are more cameras than this, only every n-th camera is used. A tour through all of them
#: would take long to compute and would look the same.
MOST_CAMERAS = 400
# The order of names is used if its length is at most this many times that of a short tour.
_LONGEST_BY_NAME = 1.6


def in_order(cameras: Sequence[Camera], names: Sequence[str], distance: float) -> list[int]:
    """Indices of the cameras in the order of a path.

    Photos of a walk and frames of a video are named in the order in which they were taken. Other
    cameras are visited by a tour with small changes of position and direction. Of the views of a
    panorama, only one is visited. ``distance``: world units from the cameras to what they see.
    """
    by_name = sorted(range(len(names)), key=lambda i: natural_key(names[i]))
    by_name = _one_per_place(cameras, by_name)
    step = -(-len(by_name) // MOST_CAMERAS)
    by_name = by_name[::step]
    chosen = [cameras[i] for i in by_name]
    places = torch.cat([positions_of(chosen) / distance, rotations_of(chosen)[:, 2]], 1)
    lengths = torch.cdist(places, places)
    tour = short_tour(lengths)
    as_named = list(range(len(by_name)))
    use_names = _length(lengths, as_named) <= _LONGEST_BY_NAME * _length(lengths, tour)
    return [by_name[i] for i in (as_named if use_names else tour)]


def _one_per_place(cameras: Sequence[Camera], order: list[int]) -> list[int]:
    """The cameras of ``order``; of those that follow one another at one place, only the one that
    looks most in the direction of the way to the next place.
    """
    centres, ahead = positions_of(cameras), rotations_of(cameras)[:, 2]
    places: list[list[int]] = []
    for i in order:
        if places and torch.allclose(centres[i], centres[places[-1][0]]):
            places[-1].append(i)
        else:
            places.append([i])
    chosen = []
    for k, place in enumerate(places):
        start, end = (k, k + 1) if k + 1 < len(places) else (max(0, k - 1), k)
        way = centres[places[end][0]] - centres[places[start][0]]
        chosen.append(max(place, key=lambda i: float(ahead[i] @ way)))
    return chosen


def short_tour(lengths: Tensor) -> list[int]:
    """A short open tour through N places, from their distances ``lengths`` (N, N).

    The tour always continues to the nearest place that is not yet visited. Then sections are
    reversed as long as that makes the tour shorter (2-opt).
    """
    count = len(lengths)
    # Start at the place that is farthest from the others; on a line of places it is an end.
    tour = [int(lengths.sum(1).argmax())] if count else []
    left = lengths.clone()
    while len(tour) < count:
        left[:, tour[-1]] = torch.inf
        tour.append(int(left[tour[-1]].argmin()))
    order = torch.tensor(tour, dtype=torch.int64)
    while count > 2:
        # Reversing places i … j replaces the step into i and the step out of j. At the ends of the
        # tour there is no such step.
        between = lengths[order][:, order]
        steps = torch.diagonal(between, 1)
        into = torch.cat([steps.new_zeros(1), steps])
        out = torch.cat([steps, steps.new_zeros(1)])
        new_into = torch.cat([steps.new_zeros(1, count), between[:-1]])  # (i, j): i − 1 to j
        new_out = torch.cat([between[:, 1:], steps.new_zeros(count, 1)], 1)  # (i, j): i to j + 1
        gain = (into[:, None] + out[None, :] - new_into - new_out).triu(1)
        best = int(gain.argmax())
        i, j = divmod(best, count)
        if float(gain[i, j]) <= 1e-9 * float(steps.sum()):
            break
        order[i : j + 1] = order[i : j + 1].flip(0)
    return order.tolist()


def _length(lengths: Tensor, tour: list[int]) -> float:
    return float(lengths[tour[:-1], tour[1:]].sum())
