"""Which frames of a video to keep: the picture moves by about the same amount between them."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from itertools import pairwise

_BISECTIONS = 40  # the step is then accurate to 1e-12 of the motion


@dataclass(frozen=True)
class Candidate:
    """A frame that may be kept."""

    moved: float  # how far the picture has moved since the first frame of the video
    sharpness: float  # a larger value is sharper
    number: int  # counts from 1, in the order of time


def choose(candidates: Sequence[Candidate], most: int) -> list[Candidate]:
    """At most ``most`` candidates, between which the picture moves by about the same amount.

    This amount is the smallest step for which ``most`` candidates are enough. After a chosen
    candidate, the next one is the sharpest of those that are half a step to a whole step farther;
    if there are none, it is the first one beyond. If fewer than ``most`` are needed, the longest
    steps are divided. No step is longer than twice the longest step of the best possible choice,
    which is the one whose longest step is the shortest.

    Args:
        candidates: in the order of time; ``moved`` never decreases.
        most: at least 1.
    """
    if len(candidates) <= most:
        return list(candidates)
    places = [candidate.moved for candidate in candidates]
    # With twice the whole motion as the step, all candidates are within half a step of the start.
    too_short, step = 0.0, 2 * (places[-1] - places[0]) + 1e-9
    chosen = _with_step(candidates, places, step)
    for _ in range(_BISECTIONS):
        middle = (too_short + step) / 2
        tried = _with_step(candidates, places, middle)
        if len(tried) <= most:
            step, chosen = middle, tried
        else:
            too_short = middle
    return [candidates[i] for i in _divided(candidates, places, chosen, most)]


def _with_step(candidates: Sequence[Candidate], places: Sequence[float], step: float) -> list[int]:
    """The positions in ``candidates`` that `choose` selects if the step is ``step``."""
    chosen: list[int] = []
    first, last = 0, places[0] - step / 2  # the next position, and the place of the last choice
    while first < len(candidates):
        nearest = bisect_right(places, last + step / 2, first)
        end = bisect_right(places, last + step, nearest)
        if not chosen:
            nearest = 0
        if nearest < end:
            best = _sharpest(candidates, nearest, end)
        elif end == len(candidates):
            break  # the rest is within half a step of the last one
        else:
            best = end
        chosen.append(best)
        first, last = best + 1, places[best]
    return chosen


def _divided(
    candidates: Sequence[Candidate], places: Sequence[float], chosen: list[int], most: int
) -> list[int]:
    """``chosen`` and candidates in the middle half of the longest steps, ``most`` in all."""
    chosen = list(chosen)
    steps = [(places[a] - places[b], a, b) for a, b in pairwise(chosen)]  # negative: longest first
    heapify(steps)
    while steps and len(chosen) < most:
        length, a, b = heappop(steps)
        first = bisect_left(places, places[a] - length / 4, a + 1, b)
        end = bisect_right(places, places[b] + length / 4, first, b)
        if length < 0 and first < end:
            between = _sharpest(candidates, first, end)
            chosen.append(between)
            heappush(steps, (places[a] - places[between], a, between))
            heappush(steps, (places[between] - places[b], between, b))
    return sorted(chosen)


def _sharpest(candidates: Sequence[Candidate], first: int, end: int) -> int:
    return max(range(first, end), key=lambda i: (candidates[i].sharpness, -i))
