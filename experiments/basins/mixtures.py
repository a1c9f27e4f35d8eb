"""Studies with several Gaussians on a line: overparametrisation and density control."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from density import DEAD, CloneAndSplit, Mcmc, Refill
from fit import DensityControl, Options, fit
from result import SUCCESS, Row, probability
from targets import AMPLITUDE, Box, Mixture, Target
from torch import Tensor

RULES = ("none", "clone and split", "noise", "MCMC", "refill")
SPACING = 5.0  # the length of the line for each target
_CHOOSE = 1000
_STARTS = 10_000  # starts and targets with the same seed would have the same random positions
_RATES = {
    "gradient descent": (0.1, 0.3, 1.0),
    "momentum": (0.03, 0.1, 0.3),
    "Adam": (0.03, 0.1, 0.3, 1.0),
}
_NOISES = (0.01, 0.03, 0.1, 0.3)


def mixture(restarts: int, k: int, seed: int) -> Mixture:
    """k targets at random places of 0..5k, with σ of 0.5 to 1.5 and amplitudes of 0.5 to 1."""
    random = torch.Generator().manual_seed(seed)
    u = torch.rand(3, restarts, k, generator=random, dtype=torch.float64)
    log_sigma = math.log(0.5) + math.log(3) * u[1]
    parameters = torch.stack([SPACING * k * u[0], log_sigma, 0.5 + 0.5 * u[2]], dim=2)
    return Mixture((0.0, SPACING * k), parameters)


def box(restarts: int, seed: int) -> Box:
    """A box of 8 to 16 between two step edges, in 0..30."""
    random = torch.Generator().manual_seed(seed)
    u = torch.rand(2, restarts, generator=random, dtype=torch.float64)
    low, size = 2 + 10 * u[0], 8 + 8 * u[1]
    return Box((0.0, 30.0), low, low + size)


def random_start(
    restarts: int, count: int, length: float, sigma: float, random: torch.Generator
) -> Tensor:
    """(restarts, count, 3): random positions in 0..length, equal widths, amplitude 0.3."""
    mean = length * torch.rand(restarts, count, generator=random, dtype=torch.float64)
    one = torch.ones_like(mean)
    return torch.stack([mean, math.log(sigma) * one, 0.3 * one], dim=2)


def run(target: Target, *settings: Any, **more: Any) -> Tensor:
    """(restarts,): the relative errors at the end of fits; the arguments are those of `solve`."""
    return target.relative_error(solve(target, *settings, **more))


def solve(
    target: Target,
    restarts: int,
    count: int,
    options: Options,
    seed: int,
    *,
    rule: str = "none",
    noise: float = 0.0,
    length: float = 30.0,
    share: float = 1.0,
) -> Tensor:
    """(restarts, count, 3): the Gaussians at the end of fits.

    They begin in the first `share` of the line. Clone-and-split begins with half of the Gaussians.
    The width at the start is half of the mean distance of the Gaussians on the whole line.
    """
    random = torch.Generator().manual_seed(_STARTS + seed)
    start = random_start(restarts, count, share * length, length / count / 2, random)
    alive = torch.ones(restarts, count, dtype=torch.bool)
    density: DensityControl | None = None
    if rule == "clone and split":
        alive[:, count // 2 :] = False
        density = CloneAndSplit(random)
    elif rule == "refill":
        density = Refill(random, target)
    elif rule != "none":
        density = Mcmc(random, noise, relocate=rule == "MCMC")
    return fit(start, target, options, alive=alive, density=density)


def _median(error: Tensor) -> float:
    return float(f"{float(error.median()):.3g}")


def counts(restarts: int, seeds: int, steps: int) -> Iterator[Row]:
    """P(success) by the number of targets, and by the number of Gaussians for six targets."""

    def measure(k: int, count: int, options: Options) -> tuple[Tensor, list[float]]:
        errors = [
            run(mixture(restarts, k, seed), restarts, count, options, seed, length=SPACING * k)
            for seed in range(seeds)
        ]
        shares = [round(float((e < SUCCESS).double().mean()), 3) for e in errors]
        return torch.cat(errors), shares

    chosen = {}
    for optimizer, rates in _RATES.items():
        target = mixture(restarts, 6, _CHOOSE)

        def score(rate: float, optimizer: str = optimizer, target: Mixture = target) -> float:
            error = run(target, restarts, 9, Options(optimizer, rate, steps=steps), _CHOOSE)
            return float((error < SUCCESS).double().mean())

        chosen[optimizer] = max(rates, key=score)
    for k in (1, 2, 3, 4, 6, 8):
        for factor in (1, 2):
            options = Options("Adam", chosen["Adam"], steps=steps)
            error, shares = measure(k, factor * k, options)
            settings = {"study": "targets", "k": k, "gaussians": factor * k, "rate": options.rate}
            yield {**probability(error < SUCCESS, **settings), "seeds": shares}
    for optimizer, rate in chosen.items():
        for count in (4, 6, 8, 9, 12, 18):
            error, shares = measure(6, count, Options(optimizer, rate, steps=steps))
            settings = {"study": "gaussians", "optimizer": optimizer, "rate": rate}
            row = probability(error < SUCCESS, **settings, k=6, gaussians=count)
            yield {**row, "median_error": _median(error), "seeds": shares}


def rules(restarts: int, seeds: int, steps: int) -> Iterator[Row]:
    """Density control: six targets, and a box, with starts everywhere or in a third of the line."""
    options = Options("Adam", 0.1, steps=steps)
    noise = {}
    for rule in ("noise", "MCMC"):
        target = mixture(restarts, 6, _CHOOSE)

        def score(value: float, rule: str = rule, target: Mixture = target) -> float:
            error = run(target, restarts, 9, options, _CHOOSE, rule=rule, noise=value)
            return float((error < SUCCESS).double().mean())

        noise[rule] = max(_NOISES, key=score)
    for signal, count, share in (
        ("mixture", 6, 1.0),
        ("mixture", 9, 1.0),
        ("mixture", 12, 1.0),
        ("mixture", 12, 1 / 3),
        ("box", 8, 1.0),
        ("box", 8, 1 / 3),
    ):
        for rule in RULES:
            errors = []
            for seed in range(seeds):
                target = mixture(restarts, 6, seed) if signal == "mixture" else box(restarts, seed)
                more = {"rule": rule, "noise": noise.get(rule, 0.0), "share": share}
                errors.append(run(target, restarts, count, options, seed, **more))
            error = torch.cat(errors)
            settings = {"study": "rules", "signal": signal, "gaussians": count, "rule": rule}
            row = probability(
                error < SUCCESS, **settings, start_share=round(share, 3), noise=noise.get(rule, 0.0)
            )
            shares = [round(float((e < SUCCESS).double().mean()), 3) for e in errors]
            yield {**row, "median_error": _median(error), "seeds": shares}


def failures(restarts: int, seeds: int, steps: int) -> Iterator[Row]:
    """What is wrong in the fits of six Gaussians to six targets that fail.

    `with_dead`: a Gaussian is dead. `shared`: a target is the nearest one of several Gaussians
    that are not dead, and another target is the nearest one of none.
    """
    for rule in ("none", "refill"):
        failed = with_dead = shared = 0
        for seed in range(seeds):
            target = mixture(restarts, 6, seed)
            end = solve(target, restarts, 6, Options("Adam", 0.1, steps=steps), seed, rule=rule)
            bad = target.relative_error(end) >= SUCCESS
            model, wanted = end[bad], target.parameters[bad]
            live = model[..., AMPLITUDE].abs() >= DEAD
            distance = (model[:, :, None, 0] - wanted[:, None, :, 0]).abs()
            nearest = torch.nn.functional.one_hot(distance.argmin(dim=2), 6) * live[..., None]
            owners = nearest.sum(dim=1)  # (failed, 6): the number of Gaussians of each target
            failed += len(model)
            with_dead += int((~live).any(dim=1).sum())
            shared += int(((owners > 1).any(dim=1) & (owners == 0).any(dim=1)).sum())
        yield {
            "study": "failures", "rule": rule, "trials": restarts * seeds, "failed": failed,
            "with_dead": with_dead, "shared": shared,
        }  # fmt: skip
