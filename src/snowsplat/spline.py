"""Smooth curves through samples: the natural cubic smoothing spline."""

from __future__ import annotations

import torch
from torch import Tensor


class Spline:
    """The curve g that makes Σ |yᵢ − g(tᵢ)|² + smoothing · ∫ |g″|² least.

    A natural cubic spline with knots at the samples: with ``smoothing`` 0 it goes through them. See
    P. J. Green, B. W. Silverman, "Nonparametric Regression and Generalized Linear Models", 1994,
    section 2.3 (Reinsch's algorithm; their γ is `_bend`).
    """

    def __init__(self, times: Tensor, values: Tensor, smoothing: float = 0.0) -> None:
        """
        Args:
            times: (K,) increasing, at least two.
            values: (K, D).

        Raises:
            ValueError: fewer than two samples, or times that do not increase.
        """
        times, values = times.to(torch.float64), values.to(torch.float64)
        steps = times.diff()
        if len(times) < 2 or not bool((steps > 0).all()):
            raise ValueError("a spline needs two samples or more, at times that increase")
        count = len(times)
        bend = torch.zeros_like(values)  # second derivatives at the knots
        if count > 2:
            inner = torch.arange(count - 2)
            # Second divided differences are Qᵀ y, and R takes the bend at the inner knots to them.
            q = torch.zeros(count, count - 2, dtype=torch.float64)
            q[inner, inner] = 1 / steps[:-1]
            q[inner + 1, inner] = -1 / steps[:-1] - 1 / steps[1:]
            q[inner + 2, inner] = 1 / steps[1:]
            r = torch.diag((steps[:-1] + steps[1:]) / 3)
            r = r + torch.diag(steps[1:-1] / 6, 1) + torch.diag(steps[1:-1] / 6, -1)
            bend[1:-1] = torch.linalg.solve(r + smoothing * q.T @ q, q.T @ values)
            values = values - smoothing * q @ bend[1:-1]
        self._times, self._values, self._bend = times, values, bend

    def __call__(self, times: Tensor) -> Tensor:
        """(N, D) at ``times`` (N,), which lie within those of the samples."""
        t = times.to(torch.float64)
        i = torch.searchsorted(self._times, t, right=True).clamp(1, len(self._times) - 1) - 1
        step = (self._times[i + 1] - self._times[i])[:, None]
        b = (t - self._times[i])[:, None] / step  # 0 at the knot before, 1 at the one after
        a = 1 - b
        line = a * self._values[i] + b * self._values[i + 1]
        cubic = (a**3 - a) * self._bend[i] + (b**3 - b) * self._bend[i + 1]
        return line + cubic * step**2 / 6
