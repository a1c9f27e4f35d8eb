"""In which order to visit cameras: as their names go, or by a short tour."""

from __future__ import annotations

import re
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.trajectory.focus import positions_of, rotations_of

#: More cameras than this are thinned out: the tour would take long, and shows nothing more.
MOST_CAMERAS = 400
# Names go along a path if that is at most so many times as long as a short tour.
_AS_GOOD = 1.6


def in_order(cameras: Sequence[Camera], names: Sequence[str], distance: float) -> list[int]:
    """Indices of the cameras along a way; ``distance`` (world units) is that to what they see.

    Photos of a walk and frames of a video have names in their order. Others are visited by a tour
    that turns and moves the picture little.
    """
    by_name = sorted(range(len(names)), key=lambda i: _natural(names[i]))
    step = -(-len(by_name) // MOST_CAMERAS)
    by_name = by_name[::step]
    chosen = [cameras[i] for i in by_name]
    places = torch.cat([positions_of(chosen) / distance, rotations_of(chosen)[:, 2]], 1)
    lengths = torch.cdist(places, places)
    tour = short_tour(lengths)
    as_named = list(range(len(by_name)))
    best = as_named if _length(lengths, as_named) <= _AS_GOOD * _length(lengths, tour) else tour
    return [by_name[i] for i in best]


def short_tour(lengths: Tensor) -> list[int]:
    """A short way through all of N places, from one end to the other; ``lengths`` is (N, N).

    Always to the nearest place not yet visited; then pieces are turned round as long as that makes
    the way shorter (2-opt).
    """
    count = len(lengths)
    # Begin at the place that is the farthest from the others: an end, if there is one.
    tour = [int(lengths.sum(1).argmax())] if count else []
    left = lengths.clone()
    while len(tour) < count:
        left[:, tour[-1]] = torch.inf
        tour.append(int(left[tour[-1]].argmin()))
    order = torch.tensor(tour, dtype=torch.int64)
    while count > 2:
        # Turning round places i … j replaces the steps into i and out of j; the ends have none.
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


def _natural(name: str) -> list[tuple[int, str]]:
    """img_9 comes before img_10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
