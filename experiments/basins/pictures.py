"""Studies with images, by the rasterizer of snowsplat: its cut-off, and density control."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator

import torch
from density import Changes, CloneAndSplit, Mcmc, Refill
from fit import DensityControl, Options, fit
from images import SIZE, Picture, blobs, draw, landscape, random_start, ring
from mixtures import RULES
from result import Row, probability
from torch import Tensor

_SIGMA = 3.0  # pixels
_GAUSSIANS = 64
_NOISE = 0.02


def cutoff(trials: int, steps: int) -> Iterator[Row]:
    """P(success) by distance, of one Gaussian and one target with σ = 3 pixels, and by ε of Adam.

    Both are cut off at 3.33 σ, where they are 1/255. So beyond 6.66 σ, the gradient is exactly 0.
    Only the position is learned; the direction and the position of the target are random.
    """
    random = torch.Generator().manual_seed(0)
    for ratio in (1, 2, 3, 4, 5, 6, 6.5, 7, 8):
        good = []
        for _ in range(trials):
            angle, x, y = (torch.rand(3, generator=random) * torch.tensor([6.2832, 1, 1])).tolist()
            far = ratio * _SIGMA / 2
            row = [SIZE / 2 + x, SIZE / 2 + y, math.log(_SIGMA), 1.0]
            shift = torch.tensor([far * math.cos(angle), far * math.sin(angle), 0, 0])
            target = Picture(draw((torch.tensor(row) + shift)[None]))
            start = (torch.tensor(row) - shift)[None, None]
            options = Options("Adam", 0.1, _SIGMA, steps, only_means=True)
            good.append(target.relative_error(fit(start, target, options)) < 0.01)
        yield probability(torch.cat(good), study="cutoff", distance=ratio)


def rules(seeds: int, steps: int) -> Iterator[Row]:
    """PSNR of three images with each rule, with starts everywhere or in one corner."""
    for name, image in (("ring", ring()), ("blobs", blobs()), ("landscape", landscape())):
        target = Picture(image)
        for where in ("everywhere", "corner"):
            for rule in RULES:
                psnr = [
                    round(target.psnr(picture_fit(target, where, rule, seed, steps)), 2)
                    for seed in range(seeds)
                ]
                yield {
                    "study": "images", "image": name, "start": where, "rule": rule,
                    "psnr": psnr, "mean": round(statistics.mean(psnr), 2),
                    "deviation": round(statistics.stdev(psnr), 2) if seeds > 1 else 0.0,
                }  # fmt: skip


def picture_fit(target: Picture, where: str, rule: str, seed: int, steps: int = 300) -> Tensor:
    """(1, 64, 4): the Gaussians of a fit that starts "everywhere" or in a "corner"."""
    random = torch.Generator().manual_seed(seed)
    high = SIZE if where == "everywhere" else SIZE / 3
    start = random_start(_GAUSSIANS, _SIGMA, 0, high, random)
    alive = torch.ones(1, _GAUSSIANS, dtype=torch.bool)
    if rule == "clone and split":
        alive[:, _GAUSSIANS // 2 :] = False
    options = Options("Adam", 0.05, _SIGMA, steps)
    return fit(start, target, options, alive=alive, density=_rule(rule, random, target))


def _rule(name: str, random: torch.Generator, target: Picture) -> DensityControl | None:
    changes = Changes(interval=20, count=4)
    if name == "none":
        return None
    if name == "clone and split":
        return CloneAndSplit(random, _SIGMA, changes)
    if name == "refill":
        return Refill(random, target, _SIGMA, changes)
    return Mcmc(random, _NOISE, name == "MCMC", changes)
