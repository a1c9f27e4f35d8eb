"""Named recipes: whole training configurations, and how single knobs of them are changed.

    config = recipe("paper", iterations=7000, max_gaussians=200_000)

A recipe is a function that makes a `TrainConfig`; one more is a function more, entered in
`RECIPES`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from snowsplat.training.config import TrainConfig, changed
from snowsplat.training.density import AdaptiveDensity, McmcDensity
from snowsplat.training.lr_schedule import LearningRates
from snowsplat.util.errors import UserError


def default() -> TrainConfig:
    """The best scene for a few thousand steps, made for a plain CPU.

    Rates are several times the paper's, those of the sizes most of all; colours follow the view
    early; the first steps see small images; no more Gaussians than such photos can show. Too
    short for opacity resets, from which a scene takes hundreds of steps to recover, and
    for pruning by size. The moments are fractions, so they scale with ``iterations``.
    """
    return TrainConfig(
        iterations=3000,
        sh_interval=100,
        initial_points=20_000,
        learning_rates=replace(
            LearningRates().scaled(3.0),
            means_final=1.6e-5,
            means_steps=1.0,
            log_scales=0.03,
            opacity_logits=0.05,
        ),
        density=AdaptiveDensity(
            densify_from=100,
            densify_until=0.5,
            prune_world_size=0.0,
            prune_screen_size=0.0,
            opacity_reset_interval=0,
            max_gaussians=120_000,
        ),
        gaussians_per_pixel=0.5,
        visible_only=True,
        coarse_to_fine=(0.15, 0.4),
        test_iterations=(),
    )


def paper() -> TrainConfig:
    """The paper's schedule, complete: 30,000 steps.

    Where the paper's moment is the end of something (densification at 15,000, the rate of the means
    at 30,000) it is a half or the whole of the training here: the same at 30,000 steps, and a
    shorter training comes to an end too. The other moments stay steps. Pruning by screen size is
    off: in pixels it depends on the resolution, and at 270×480 it costs half a dB.
    """
    return TrainConfig(
        learning_rates=LearningRates(means_steps=1.0),
        density=AdaptiveDensity(densify_until=0.5, prune_screen_size=0.0),
    )


def mcmc() -> TrainConfig:
    """The schedule of "3D Gaussian Splatting as Markov Chain Monte Carlo": 30,000 steps, a hard
    cap.

    Every Gaussian takes part in every step: the regularisers pull on those out of view as well.
    """
    return TrainConfig(
        density=McmcDensity(max_gaussians=200_000), initial_opacity=0.5, initial_scale=0.1
    )


RECIPES: dict[str, Callable[[], TrainConfig]] = {"default": default, "paper": paper, "mcmc": mcmc}


def recipe(name: str = "default", **knobs: Any) -> TrainConfig:
    """A named recipe with some ``knobs`` changed, as `changed` does.

    Raises:
        UserError: no such recipe, or it has no such knob.
    """
    if name not in RECIPES:
        raise UserError(f"no recipe {name!r}; there are {', '.join(RECIPES)}")
    return changed(RECIPES[name](), **knobs)
