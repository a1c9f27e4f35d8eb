"""Chooses the frames of a video to keep: sharp frames with about the same motion between them.

The motion is how far the image content moves, as `motion.FrameMotion` measures it.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from itertools import pairwise
from typing import TypeVar

_BISECTIONS = 40  # with this number, the step is accurate to 1e-12 of the motion of the video


@dataclass(frozen=True)
class Candidate:
    """A frame that may be kept."""

    moved: float  # motion since the first frame of the video, as a fraction of the longest side
    sharpness: float  # a larger value is sharper
    number: int  # counts from 1, in the order of time


_Any = TypeVar("_Any", bound=Candidate)


def choose(candidates: Sequence[_Any], max_count: int) -> list[_Any]:
    """At most ``max_count`` candidates, with about the same motion between them.

    This motion is called the step. After a chosen candidate, the next one is the sharpest of those
    that are half a step to a whole step farther; if there are none, it is the first one that is
    more than a step farther. The smallest step is used for which ``max_count`` candidates are
    enough. If fewer are needed, candidates in the middle of the longest steps are added.

    No step of the result is longer than twice the longest step of the best possible choice, which
    is the one whose longest step is the shortest.

    Args:
        candidates: in the order of time; ``moved`` never decreases.
        max_count: at least 1.
    """
    if len(candidates) <= max_count:
        return list(candidates)
    moved = [candidate.moved for candidate in candidates]
    # With twice the whole motion as the step, all candidates are within half a step of the start.
    too_short, step = 0.0, 2 * (moved[-1] - moved[0]) + 1e-9
    chosen = _with_step(candidates, moved, step)
    for _ in range(_BISECTIONS):
        middle = (too_short + step) / 2
        tried = _with_step(candidates, moved, middle)
        if len(tried) <= max_count:
            step, chosen = middle, tried
        else:
            too_short = middle
    return [candidates[i] for i in _with_divided_steps(candidates, moved, chosen, max_count)]


def _with_step(candidates: Sequence[Candidate], moved: Sequence[float], step: float) -> list[int]:
    """The indices of the candidates that `choose` selects if the step is ``step``. ``moved``: the
    motion of each candidate."""
    chosen: list[int] = []
    first, last = 0, moved[0] - step / 2  # the next index, and the motion of the last choice
    while first < len(candidates):
        nearest = bisect_right(moved, last + step / 2, first)
        end = bisect_right(moved, last + step, nearest)
        if not chosen:
            nearest = 0
        if nearest < end:
            best = _sharpest(candidates, nearest, end)
        elif end == len(candidates):
            break  # all other candidates are within half a step of the last choice
        else:
            best = end
        chosen.append(best)
        first, last = best + 1, moved[best]
    return chosen


def _with_divided_steps(
    candidates: Sequence[Candidate], moved: Sequence[float], chosen: list[int], max_count: int
) -> list[int]:
    """Add indices to ``chosen`` until there are ``max_count``, if possible. Each addition divides
    the longest step: it is the sharpest candidate in the middle half of it."""
    chosen = list(chosen)
    # The lengths are negative, so that the heap returns the longest step first.
    steps = [(moved[a] - moved[b], a, b) for a, b in pairwise(chosen)]
    heapify(steps)
    while steps and len(chosen) < max_count:
        length, a, b = heappop(steps)
        first = bisect_left(moved, moved[a] - length / 4, a + 1, b)
        end = bisect_right(moved, moved[b] + length / 4, first, b)
        if length < 0 and first < end:
            between = _sharpest(candidates, first, end)
            chosen.append(between)
            heappush(steps, (moved[a] - moved[between], a, between))
            heappush(steps, (moved[between] - moved[b], between, b))
    return sorted(chosen)


def _sharpest(candidates: Sequence[Candidate], first: int, end: int) -> int:
    return max(range(first, end), key=lambda i: (candidates[i].sharpness, -i))
