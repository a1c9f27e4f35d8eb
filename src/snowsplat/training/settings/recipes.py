"""Recipes: complete training configurations by name.

    config = recipe("paper", iterations=7000, max_gaussians=200_000)

A recipe is a function that returns a `TrainConfig`. `register_recipe` adds one to `RECIPES`.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.density import AdaptiveDensity, McmcDensity
from snowsplat.training.settings.names import changed
from snowsplat.training.settings.rates import DecayRates, LearningRates
from snowsplat.util.messages import Message, message
from snowsplat.util.settings import Setting, checked, suggestion


def default() -> TrainConfig:
    """The best quality for a few thousand steps on a CPU.

    It is `classic` with these changes, which docs/performance.md measures: the training starts with
    points on the surfaces, which are found by plane sweep, and in the sky; in the last part of the
    training, all learning rates decrease; opacities and scales decay, so that Gaussians which no
    photo needs become transparent; with few passes over the photos, view-dependent colours change
    faster, and there are more steps, with small images for longer; the mean of gradients covers
    fewer steps, and the last steps decrease squared differences; Gaussians with an opacity below
    0.1 are removed, and their places are used again; no Gaussian is much nearer to a camera than
    the points that it sees; densification lasts longer, uses absolute gradients, and always reaches
    the maximum number; more Gaussians and fewer steps take the same time; objects that move between
    the photos are masked; gains correct different exposures; and the scene is antialiased.
    """
    config = classic()
    return replace(
        config,
        iterations=2000,
        init="points+sweep",
        initial_points=0.4,
        initial_opacity=0.3,
        initial_scale=0.6,
        beta1=0.8,
        huber_weight=10.0,
        sky=True,
        learning_rates=replace(
            config.learning_rates, sh_rest_passes=40.0, anneal=0.1, anneal_from=0.7
        ),
        decay=DecayRates(opacity=0.04, scale=0.02, until=0.7),
        relative_scale=0.3,
        near_limit=0.6,
        transients="auto",
        exposure="auto",
        antialias=True,
        density=replace(
            config.density,
            densify_until=0.7,
            grad_threshold=1e-4,
            abs_grad=True,
            prune_opacity=0.1,
            max_gaussians=200_000,
        ),
        gaussians_per_pixel=0.6,
        limit_views=50,
        few_passes=20.0,
    )


def classic() -> TrainConfig:
    """The schedule of the paper, shortened to a few thousand steps: the earlier default recipe.

    The learning rates are several times those of the paper; the rate of the scales is increased
    most. View-dependent colour starts early. The first steps use small images. The number of
    Gaussians is limited by the number of pixels of a photo. There are no opacity resets, because a
    scene needs hundreds of steps to recover from one, and no pruning by size. Moments are
    fractions, so they scale with ``iterations``.
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
    """The complete schedule of the paper: 30,000 steps.

    Densification ends at step 15,000, and the decay of the means' learning rate at step 30,000.
    Both are given as fractions, 0.5 and 1, so that a shorter training run also reaches them. The
    other moments are steps. Pruning by screen size is disabled, because its limit in pixels does
    not suit every resolution: at 270×480 it reduces the PSNR by 0.5 dB.
    """
    return TrainConfig(
        learning_rates=LearningRates(means_steps=1.0),
        density=AdaptiveDensity(densify_until=0.5, prune_screen_size=0.0),
    )


def mcmc() -> TrainConfig:
    """The schedule of "3D Gaussian Splatting as Markov Chain Monte Carlo": 30,000 steps and a fixed
    limit of Gaussians.

    The optimiser updates all Gaussians in every step, because the regularisers also apply to
    invisible ones.
    """
    return TrainConfig(
        density=McmcDensity(max_gaussians=200_000), initial_opacity=0.5, initial_scale=0.1
    )


def mcmc_short() -> TrainConfig:
    """`mcmc` for 3000 steps.

    The number of Gaussians reaches its limit after about a fifth of the steps. The learning rates
    are those of `classic`, three times those of the paper, so the noise, which is relative to them,
    is a third. It ends when the rates begin to decrease.
    """
    config = classic()
    return replace(
        config,
        learning_rates=replace(config.learning_rates, anneal=0.1, anneal_from=0.7),
        density=McmcDensity(
            densify_from=100,
            densify_until=0.8,
            densify_interval=50,
            max_gaussians=120_000,
            growth=0.25,
            noise=1.6e5,
            noise_until=0.7,
        ),
        initial_opacity=0.3,
        initial_scale=0.5,
        visible_only=False,
    )


RECIPES: dict[str, Callable[[], TrainConfig]] = {
    "default": default,
    "classic": classic,
    "paper": paper,
    "mcmc": mcmc,
    "mcmc-short": mcmc_short,
}


def register_recipe(name: str, make: Callable[[], TrainConfig]) -> None:
    """Add a recipe under a name, for `recipe` and ``TrainOptions.recipe``."""
    RECIPES[name] = make


def check_recipe(name: str) -> Message | None:
    """What is wrong with the name of a recipe; None: nothing."""
    if name in RECIPES:
        return None
    advice = suggestion(name, list(RECIPES)) or message("use one of {names}", names=[*RECIPES])
    return message("is unknown; {advice}", advice=advice)


def recipe(name: str = "default", **settings: Any) -> TrainConfig:
    """A recipe by name, with other values for some settings; see `changed`.

    Raises:
        SettingError: there is no such recipe, it has no such setting, or a value is invalid.
    """
    checked("recipe", name, str, Setting(check=check_recipe))
    return changed(RECIPES[name](), **settings)
