"""Rows of the result file, and the interval of a probability."""

from __future__ import annotations

import math

from torch import Tensor

#: A fit is a success if its squared error is below this share of the squared target. A mixture of
#: `mixtures` with a missing Gaussian has a larger error.
SUCCESS = 0.01

Row = dict[str, object]


def wilson(successes: int, trials: int, z: float = 1.96) -> tuple[float, float]:
    """The 95% confidence interval of a probability (Wilson 1927)."""
    share = successes / trials
    scale = 1 + z * z / trials
    middle = (share + z * z / (2 * trials)) / scale
    half = z / scale * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials**2))
    return max(0.0, middle - half), min(1.0, middle + half)


def probability(success: Tensor, **settings: object) -> Row:
    """A row with the share of successes (trials,) bool."""
    successes, trials = int(success.sum()), len(success)
    low, high = wilson(successes, trials)
    values = {"trials": trials, "successes": successes, "low": round(low, 4)}
    return {**settings, **values, "high": round(high, 4), "share": round(successes / trials, 4)}
