"""Studies with one Gaussian and one or two targets: the basin."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache

import torch
from closed_form import escape_time, overlap, reach, visible_distance
from fit import Options, fit
from result import SUCCESS, Row, probability
from targets import MEAN, Mixture
from torch import Tensor

_RATES = {
    "gradient descent": (0.1, 0.3, 1.0, 2.0, 3.0),
    "momentum": (0.01, 0.03, 0.1, 0.3, 1.0, 3.0),
    "Adam": (0.003, 0.01, 0.03, 0.1, 0.3),
}
_DISTANCES = torch.arange(0, 10.25, 0.5, dtype=torch.float64)
_TARGET = torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64)
_CHOOSE = 1000  # the seed that chooses rates; it is not used for results
_DOMAIN = (-12.0, 12.0)


def starts(distances: Tensor, sigma: tuple[float, float], trials: int, seed: int) -> Tensor:
    """(D · trials, 1, 3): for each distance, random widths (log-uniform) and amplitudes."""
    random = torch.Generator().manual_seed(seed)
    count = len(distances) * trials
    low, high = map(math.log, sigma)
    u = torch.rand(2, count, generator=random, dtype=torch.float64)
    columns = [distances.repeat_interleave(trials), low + (high - low) * u[0], 0.25 + 0.75 * u[1]]
    return torch.stack(columns, dim=1)[:, None]


def _successes(start: Tensor, target: Mixture, options: Options, per: int) -> Tensor:
    """(len(start) / per, per) bool. If only the means are learned: whether they are near 0."""
    end = fit(start, target, options)
    if options.only_means:
        good = end[..., MEAN].abs()[:, 0, 0] < 0.1
    else:
        good = target.relative_error(end) < SUCCESS
    return good.reshape(-1, per)


@cache
def _best_rate(optimizer: str, n: int, only_means: bool, steps: int) -> float:
    """The rate with the most successes from all distances."""
    start = starts(_DISTANCES, (0.5, 2.0), 20, _CHOOSE)
    target = Mixture(_DOMAIN, _TARGET, n)

    def successes(rate: float) -> float:
        options = Options(optimizer, rate, steps=steps, only_means=only_means)
        return float(_successes(start, target, options, 20).double().mean())

    return max(_RATES[optimizer], key=successes)


def basin(trials: int, steps: int) -> Iterator[Row]:
    """P(success) by distance, for each optimiser, in one to three dimensions."""
    for n in (1, 2, 3):
        target = Mixture(_DOMAIN, _TARGET, n)
        start = starts(_DISTANCES, (0.5, 2.0), trials, seed=n)
        for optimizer in _RATES:
            for only_means in (True, False):
                rate = _best_rate(optimizer, n, only_means, steps)
                options = Options(optimizer, rate, steps=steps, only_means=only_means)
                good = _successes(start, target, options, trials)
                for d, row in zip(_DISTANCES.tolist(), good, strict=True):
                    settings = {"n": n, "optimizer": optimizer, "only_means": only_means}
                    yield probability(row, study="basin", **settings, rate=rate, distance=d)


def travel(steps: int) -> Iterator[Row]:
    """The largest distance from which gradient descent arrives, and the closed form.

    Only the mean is learned, and σ = τ = a = A = 1. The cosine schedule has the mean rate / 2.
    """
    for count in (steps // 10, steps, steps * 10):
        for rate in (0.1, 1.0):
            d = torch.arange(0, 9, 0.02, dtype=torch.float64)
            start = torch.stack([d, torch.zeros_like(d), torch.ones_like(d)], dim=1)[:, None]
            options = Options("gradient descent", rate, steps=count, only_means=True)
            end = fit(start, Mixture(_DOMAIN, _TARGET), options)
            arrived = d[end[:, 0, 0].abs() < math.sqrt(2) / 10]
            expected = reach(rate * count / 2, 1.0, 1.0)
            yield {
                "study": "travel", "steps": count, "rate": rate,
                "measured": round(float(arrived.max()), 3), "expected": round(expected, 3),
            }  # fmt: skip


def width(trials: int, steps: int) -> Iterator[Row]:
    """P(success) by the width at the start, for distances uniform in 0..10."""
    random = torch.Generator().manual_seed(11)
    for n in (1, 2):
        for optimizer in ("gradient descent", "Adam"):
            rate = _best_rate(optimizer, n, False, steps)
            for exponent in range(-2, 10):
                sigma = 2 ** (exponent / 2)
                d = 10 * torch.rand(4 * trials, generator=random, dtype=torch.float64)
                start = starts(d, (sigma, sigma), 1, seed=exponent + 12)
                options = Options(optimizer, rate, steps=steps)
                good = _successes(start, Mixture(_DOMAIN, _TARGET, n), options, len(start))
                settings = {"n": n, "optimizer": optimizer, "rate": rate}
                yield probability(good[0], study="width", **settings, sigma=round(sigma, 3))


def blur(trials: int, steps: int) -> Iterator[Row]:
    """P(success) by distance, if the target is blurred at first (coarse to fine)."""
    distances = torch.arange(0, 20.5, 1.0, dtype=torch.float64)
    start = starts(distances, (0.5, 2.0), trials, seed=5)
    for optimizer in ("gradient descent", "Adam"):
        rate = _best_rate(optimizer, 1, False, steps)
        for s in (0.0, 2.0, 4.0, 8.0):
            options = Options(optimizer, rate, steps=steps, blur=s)
            good = _successes(start, Mixture(_DOMAIN, _TARGET), options, trials)
            for d, row in zip(distances.tolist(), good, strict=True):
                yield probability(
                    row, study="blur", optimizer=optimizer, rate=rate, blur=s, distance=d
                )


def adam_limits(trials: int, steps: int) -> Iterator[Row]:
    """The reach of Adam, limited by ε, by the precision, or by noise in the gradient.

    Only the mean is learned; σ = τ = a = A = 1. `measured`: the largest distance d such that at
    least half of the starts arrive from d and from all smaller distances.
    """
    d = torch.arange(1, 24, 0.25, dtype=torch.float64)
    one = torch.tensor([0.0, 1.0], dtype=torch.float64)
    start = torch.cat([d.repeat_interleave(trials)[:, None], one.repeat(len(d) * trials, 1)], 1)
    single = {"dtype": "float32"}
    cases: list[dict[str, object]] = [{"eps": 1e-8}, {"eps": 1e-15}, {"eps": 1e-8, **single}]
    cases += [{"eps": 1e-15, **single}]
    cases += [{"eps": 1e-15, "gradient_noise": v} for v in (1e-6, 1e-4, 1e-2)]
    for case in cases:
        options = Options(
            "Adam", 0.1, steps=steps, only_means=True, eps=float(str(case["eps"])),
            gradient_noise=float(str(case.get("gradient_noise", 0.0))),
        )  # fmt: skip
        dtype = torch.float32 if case.get("dtype") else torch.float64
        random = torch.Generator().manual_seed(3)
        target = Mixture(_DOMAIN, _TARGET.to(dtype))
        end = fit(start[:, None].to(dtype), target, options, generator=random)
        share = (end[:, 0, 0].abs() < 0.2).reshape(-1, trials).double().mean(1)
        first = int((share < 0.5).int().argmax()) if bool((share < 0.5).any()) else len(d)
        scale = max(options.eps, options.gradient_noise)
        yield {
            "study": "adam", "eps": options.eps, "gradient_noise": options.gradient_noise,
            "dtype": str(dtype).removeprefix("torch."), "trials": trials,
            "measured": float(d[first - 1]) if first else 0.0,
            "gradient_equals_limit": round(visible_distance(scale, 1.0, 1.0), 2),
        }  # fmt: skip


def two_targets(trials: int, steps: int) -> Iterator[Row]:
    """The share of starts that end in the middle of two targets at ±h; ρ² = 2."""
    rho = math.sqrt(2)
    for ratio in (0.5, 0.7, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 1.5, 2.0):
        h = ratio * rho
        pair = torch.tensor([[[-h, 0.0, 1.0], [h, 0.0, 1.0]]], dtype=torch.float64)
        random = torch.Generator().manual_seed(9)
        start = torch.zeros(trials, 1, 3, dtype=torch.float64)
        start[:, 0, 0] = h * (2 * torch.rand(trials, generator=random, dtype=torch.float64) - 1)
        start[:, 0, 2] = 1
        options = Options("gradient descent", 0.5, steps=10 * steps, only_means=True)
        end = fit(start, Mixture(_DOMAIN, pair), options)
        middle = end[:, 0, 0].abs() < 0.05
        yield probability(middle, study="two_targets", h_over_rho=ratio)


def escape(walkers: int) -> Iterator[Row]:
    """The mean time in which noise carries a Gaussian from the lower to the higher target.

    The targets are at ±2 with the amplitudes 1 and 0.7; σ = τ = 1, a = 1 are fixed. The time is
    measured until the other minimum; walkers that do not arrive count with their whole time, as for
    an exponential distribution.
    """
    m = torch.linspace(-5, 5, 100_001, dtype=torch.float64)
    loss = -(overlap(m - 2, 1.0, 1.0) + 0.7 * overlap(m + 2, 1.0, 1.0))
    inner = loss[1:-1]
    well, goal = (int(i) + 1 for i in ((inner < loss[:-2]) & (inner < loss[2:])).nonzero())
    top = int(((inner > loss[:-2]) & (inner > loss[2:])).nonzero()[0]) + 1
    spacing = float(m[1] - m[0])
    curvature = (loss[2:] - 2 * inner + loss[:-2]) / spacing**2
    rate, height = 0.05, float(loss[top] - loss[well])
    for ratio in (1.5, 2.0, 3.0, 4.0):
        noise = height / ratio
        expected = escape_time(
            float(loss[well]), float(loss[top]), float(curvature[well - 1]),
            float(curvature[top - 1]), noise,
        )  # fmt: skip
        random = torch.Generator().manual_seed(4)
        place = m[well].repeat(walkers)
        time, arrived = 0.0, 0
        for _ in range(int(3 * expected / rate)):
            gradient = _two_gradient(place)
            xi = torch.randn(len(place), generator=random, dtype=torch.float64)
            place = place - rate * gradient + math.sqrt(2 * rate * noise) * xi
            # Far away, nothing pulls a walker back, so that there is a wall.
            place = torch.where(place < -5, -10 - place, place)
            time += rate * len(place)
            there = place >= m[goal]
            arrived += int(there.sum())
            place = place[~there]
            if len(place) == 0:
                break
        yield {
            "study": "escape", "barrier_over_noise": ratio, "walkers": walkers,
            "arrived": arrived, "expected": round(expected, 1),
            "measured": round(time / max(arrived, 1), 1),
        }  # fmt: skip


def _two_gradient(place: Tensor) -> Tensor:
    """dL/dm for `escape`."""
    right, left = place - 2, place + 2
    return (right * overlap(right, 1.0, 1.0) + 0.7 * left * overlap(left, 1.0, 1.0)) / 2
