"""The flags of `snowsplat train` that are settings of its configuration, under the same names."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

from snowsplat.cli.flags import flag

RECIPE = "the recipe's"


@dataclass
class ConfigFlags:
    """One flag per setting. None: the recipe determines the setting."""

    iterations: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Training steps, one photo each."""
    max_gaussians: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Largest number of Gaussians; determines memory and time. 0: no limit."""
    checkpoint_every: Annotated[int | None, flag("N", default="none")] = None
    """Steps between checkpoints. With --resume the result is the same as without interruption."""
    seed: Annotated[int | None, flag("N", default="0")] = None
    """Seed of all random choices. The same seed gives a bit-identical scene, on the CPU and, with
    --deterministic, on a GPU."""
    test_iterations: Annotated[tuple[int, ...] | None, flag("[N ...]", default=RECIPE)] = None
    """Steps after which to evaluate the held-out photos, in addition to the last one; -1: none."""
    background: Annotated[
        Literal["black", "white", "random"] | None,
        flag("{black,white,random}", default="black"),
    ] = None
    """Color behind the scene, and behind transparent photos."""

    sh_degree: Annotated[int | None, flag("{0,1,2,3}", default="3")] = None
    """Degree of the view-dependent color. A lower degree takes less memory."""
    ssim_weight: Annotated[float | None, flag("F", "--lambda-dssim", default=RECIPE)] = None
    """Weight of 1 - SSIM in the loss; the rest is the mean absolute difference."""
    initial_points: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Number of random Gaussians to start from if the dataset has no points."""
    grad_threshold: Annotated[
        float | None, flag("F", "--densify-grad-threshold", default=RECIPE)
    ] = None
    """Densify where the view-space gradient is larger. Raise it for fewer Gaussians."""
    densify_interval: Annotated[
        int | None, flag("N", "--densification-interval", default=RECIPE)
    ] = None
    """Steps between densifications. Raise it for fewer Gaussians."""
    densify_from: Annotated[
        int | float | None, flag("N|F", "--densify-from-iter", default=RECIPE)
    ] = None
    """First step that may densify; with a decimal point (0.1), that fraction of all steps."""
    densify_until: Annotated[
        int | float | None, flag("N|F", "--densify-until-iter", default=RECIPE)
    ] = None
    """Last step that may densify; with a decimal point (0.5), that fraction of all steps."""
    opacity_reset_interval: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Steps between resets of the opacity; 0: none."""
    percent_dense: Annotated[float | None, flag("F", default=RECIPE)] = None
    """Gaussians smaller than this fraction of the scene extent are cloned, larger ones split."""

    lr_means: Annotated[float | None, flag("F", "--position-lr-init", default=RECIPE)] = None
    """Learning rate of the positions at the first step, in scene extents."""
    lr_means_final: Annotated[float | None, flag("F", "--position-lr-final", default=RECIPE)] = None
    """Learning rate of the positions at the last step."""
    lr_means_steps: Annotated[
        int | float | None, flag("N|F", "--position-lr-max-steps", default=RECIPE)
    ] = None
    """The step at which the learning rate of the positions reaches its last value."""
    lr_log_scales: Annotated[float | None, flag("F", "--scaling-lr", default=RECIPE)] = None
    """Learning rate of the scales."""
    lr_quats: Annotated[float | None, flag("F", "--rotation-lr", default=RECIPE)] = None
    """Learning rate of the rotations."""
    lr_opacity_logits: Annotated[float | None, flag("F", "--opacity-lr", default=RECIPE)] = None
    """Learning rate of the opacities."""
    lr_sh_dc: Annotated[float | None, flag("F", default=RECIPE)] = None
    """Learning rate of the base colors."""
    lr_sh_rest: Annotated[float | None, flag("F", default=RECIPE)] = None
    """Learning rate of the view-dependent colors."""

    def config_settings(self) -> dict[str, Any]:
        """The settings that were given: name -> value."""
        given = {field.name: getattr(self, field.name) for field in fields(ConfigFlags)}
        if self.test_iterations is not None:
            given["test_iterations"] = tuple(step for step in self.test_iterations if step > 0)
        return {name: value for name, value in given.items() if value is not None}
