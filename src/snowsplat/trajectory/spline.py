"""Smooth curves through samples: the natural cubic smoothing spline."""

import numpy as np
import torch
from torch import Tensor

#: Samples per frame for measuring the length of a path.
SAMPLES_PER_FRAME = 20


class Spline:
    """The curve g that minimises Σ |yᵢ − g(tᵢ)|² + smoothing · ∫ |g″|².

    It is a natural cubic spline with knots at the samples. With ``smoothing`` 0 it interpolates
    them. See P. J. Green, B. W. Silverman, "Nonparametric Regression and Generalized Linear
    Models", 1994, section 2.3 (Reinsch's algorithm; their γ is `_second`).
    """

    def __init__(self, times: Tensor, values: Tensor, smoothing: float = 0.0) -> None:
        """
        Args:
            times: (K,) increasing, K ≥ 2.
            values: (K, D).
            smoothing: ≥ 0, in units of time³.

        Raises: ValueError: there are fewer than two samples, or the times do not increase.
        """
        times, values = times.to(torch.float64), values.to(torch.float64)
        steps = times.diff()
        if len(times) < 2 or not bool((steps > 0).all()):
            raise ValueError("a spline needs at least two samples, at increasing times")
        count = len(times)
        second = torch.zeros_like(values)  # second derivatives at the knots
        if count > 2:
            # Solve (R + smoothing · Qᵀ Q) γ = Qᵀ y for the second derivatives γ at the inner
            # knots. Qᵀ y are the second divided differences. Q has three entries per column and R
            # three diagonals, so the matrix has five diagonals.
            first, last = 1 / steps[:-1], 1 / steps[1:]
            middle = -first - last
            diagonal = (steps[:-1] + steps[1:]) / 3
            diagonal = diagonal + smoothing * (first**2 + middle**2 + last**2)
            beside = middle[:-1] * first[1:] + last[:-1] * middle[1:]
            beside = steps[1:-1] / 6 + smoothing * beside
            beyond = smoothing * last[:-2] * first[2:]
            first, middle, last = first[:, None], middle[:, None], last[:, None]
            differences = first * values[:-2] + middle * values[1:-1] + last * values[2:]
            inner = _solve(diagonal, beside, beyond, differences)
            second[1:-1] = inner
            values = values.clone()
            values[:-2] -= smoothing * first * inner
            values[1:-1] -= smoothing * middle * inner
            values[2:] -= smoothing * last * inner
        self._times = times
        self._values = values
        self._second = second

    def __call__(self, times: Tensor) -> Tensor:
        """Values (N, D) at ``times`` (N,), which must be within the range of the samples."""
        t = times.to(torch.float64)
        i = torch.searchsorted(self._times, t, right=True).clamp(1, len(self._times) - 1) - 1
        step = (self._times[i + 1] - self._times[i])[:, None]
        b = (t - self._times[i])[:, None] / step  # 0 at the knot before t, 1 at the knot after t
        a = 1 - b
        line = a * self._values[i] + b * self._values[i + 1]
        cubic = (a**3 - a) * self._second[i] + (b**3 - b) * self._second[i + 1]
        return line + cubic * step**2 / 6


def _solve(diagonal: Tensor, beside: Tensor, beyond: Tensor, right: Tensor) -> Tensor:
    """Solve A x = right for x, (M, D).

    A is symmetric and positive definite with five diagonals; three of them are given. The
    factorisation A = L D Lᵀ is computed row by row, so time and memory are linear in M.
    """
    rows = right.numpy().copy()
    near, far = [*beside.tolist(), 0.0], [*beyond.tolist(), 0.0, 0.0]
    pivots = diagonal.tolist()
    for i in range(len(pivots)):
        # Eliminate column i from the two rows below row i.
        a, b = near[i] / pivots[i], far[i] / pivots[i]
        if i + 1 < len(pivots):
            pivots[i + 1] -= a * near[i]
            near[i + 1] -= a * far[i]
            rows[i + 1] -= a * rows[i]
        if i + 2 < len(pivots):
            pivots[i + 2] -= b * far[i]
            rows[i + 2] -= b * rows[i]
        near[i], far[i] = a, b
    rows /= np.array(pivots)[:, None]
    for i in reversed(range(len(pivots) - 1)):
        rows[i] -= near[i] * rows[i + 1]
        if i + 2 < len(pivots):
            rows[i] -= far[i] * rows[i + 2]
    return torch.from_numpy(rows)


def interpolate(x: Tensor, xs: Tensor, ys: Tensor) -> Tensor:
    """Linear interpolation of the samples (xs, ys) at x; xs is ascending."""
    i = torch.searchsorted(xs, x).clamp(1, len(xs) - 1)
    share = (x - xs[i - 1]) / (xs[i] - xs[i - 1]).clamp_min(1e-300)
    return ys[i - 1] + share * (ys[i] - ys[i - 1])
