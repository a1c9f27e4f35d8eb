"""The flags of `snowsplat train` that are settings of its configuration, under the same names."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

from snowsplat.cli.flags import flag

RECIPE = "set by the recipe"


@dataclass
class ConfigFlags:
    """One flag for each setting. If a flag is None, the recipe determines the setting."""

    iterations: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Number of training steps; each uses one photo."""
    batch: Annotated[int | None, flag("N", default="1")] = None
    """Number of photos per update of the Gaussians. All other settings still count photos; the
    learning rates are multiplied by the square root of N."""
    max_gaussians: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Maximum number of Gaussians, which determines memory and time; 0: no limit."""
    checkpoint_every: Annotated[int | None, flag("N", default="none")] = None
    """Save a checkpoint every N steps. --resume can continue from it."""
    seed: Annotated[int | None, flag("N", default="0")] = None
    """Seed of all random choices. On the CPU, the same seed produces a bit-identical scene; on a
    GPU, this requires --deterministic."""
    test_iterations: Annotated[tuple[int, ...] | None, flag("[N ...]", default=RECIPE)] = None
    """Steps after which to evaluate the scene on the held-out photos, in addition to the last step;
    -1: only after the last step."""
    background: Annotated[
        Literal["black", "white", "random"] | None,
        flag("{black,white,random}", default="black"),
    ] = None
    """Colour of the background of the scene and of transparent photos."""
    leave_out_after: Annotated[int | float | None, flag("N|F", default="0")] = None
    """After this step, leave out the training photos that the scene does not explain: their camera
    poses are probably wrong. A value with a decimal point (0.15) is a fraction of all steps; 0:
    never."""
    transients: Annotated[
        Literal["auto", "on", "off"] | None, flag("{auto,on,off}", default=RECIPE)
    ] = None
    """Whether to mask what moves, such as people who walk past: it looks different from what the
    other photos show at this place. auto: if there are at least 30 photos and something moves in
    several of them; on: in any of at least 8 photos, and add Gaussians only after the first masks
    are known."""
    stop_overfitting: Annotated[Literal["on", "off"] | None, flag("{on,off}", default="off")] = None
    """Whether the training ends earlier if the views between the photos become worse. This happens
    in long training runs with few photos. The dataset needs points."""

    exposure: Annotated[
        Literal["auto", "on", "off"] | None, flag("{auto,on,off}", default=RECIPE)
    ] = None
    """Whether to learn a gain for each photo and colour channel, for photos with different
    exposures or white balances. auto: if the photos differ by at least 0.05 EV."""
    antialias: Annotated[Literal["on", "off"] | None, flag("{on,off}", default=RECIPE)] = None
    """Whether to train a scene that also looks right in images that are smaller or larger than the
    photos. The scene file is marked. off: for viewers that draw as the reference implementation
    does, in images of the size of the photos."""

    sh_degree: Annotated[int | None, flag("{0,1,2,3}", default="3")] = None
    """Degree of the spherical harmonics (view-dependent colour). A lower degree needs less
    memory."""
    ssim_weight: Annotated[float | None, flag("F", "--lambda-dssim", default=RECIPE)] = None
    """Weight of 1 - SSIM in the loss. The mean absolute difference has the weight 1 - F."""
    init: Annotated[str | None, flag("START[+START…]", default=RECIPE)] = None
    """Where the first Gaussians come from. points: the points of the dataset; sweep: depth maps
    computed from the photos (plane sweep); depth: the depth maps of the dataset (depths/IMG.png);
    carve: voxels with the same colour in all photos (space carving); random: random depths of
    random pixels. Example: points+sweep."""
    initial_points: Annotated[int | float | None, flag("N|F", default=RECIPE)] = None
    """Number of points of each start except points, which uses all. A value with a decimal point
    (0.4) is a share of the maximum number of Gaussians."""
    sky: Annotated[Literal["on", "off"] | None, flag("{on,off}", default=RECIPE)] = None
    """Whether to start with Gaussians far behind the scene if the photos show the sky, and with
    none before it. The dataset needs points."""
    sky_distance: Annotated[float | None, flag("F", default="100 x the size of the path")] = None
    """Distance of these Gaussians from the middle of the cameras, in units of the scene."""
    grad_threshold: Annotated[
        float | None, flag("F", "--densify-grad-threshold", default=RECIPE)
    ] = None
    """Clone or split Gaussians whose view-space gradient exceeds this threshold. With a larger
    value, fewer Gaussians are added."""
    abs_grad: Annotated[Literal["on", "off"] | None, flag("{on,off}", default=RECIPE)] = None
    """Whether --grad-threshold applies to the sum of the absolute gradients of the 16x16 tiles of
    the image. In this sum, gradients of opposite directions do not cancel, so more Gaussians are
    cloned or split in detailed regions."""
    densify_interval: Annotated[
        int | None, flag("N", "--densification-interval", default=RECIPE)
    ] = None
    """Number of steps between densifications. With a larger value, fewer Gaussians are added."""
    densify_from: Annotated[
        int | float | None, flag("N|F", "--densify-from-iter", default=RECIPE)
    ] = None
    """First step of densification. A value with a decimal point (0.1) is a fraction of all
    steps."""
    densify_until: Annotated[
        int | float | None, flag("N|F", "--densify-until-iter", default=RECIPE)
    ] = None
    """Last step of densification. A value with a decimal point (0.5) is a fraction of all steps."""
    opacity_reset_interval: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Number of steps between opacity resets; 0: no resets."""
    percent_dense: Annotated[float | None, flag("F", default=RECIPE)] = None
    """Densification clones Gaussians smaller than this fraction of the scene extent, and splits
    larger ones."""

    lr_means: Annotated[float | None, flag("F", "--position-lr-init", default=RECIPE)] = None
    """Learning rate of the positions at the first step, in units of the scene extent."""
    lr_means_final: Annotated[float | None, flag("F", "--position-lr-final", default=RECIPE)] = None
    """Learning rate of the positions from step --position-lr-max-steps on, in the same units."""
    lr_means_steps: Annotated[
        int | float | None, flag("N|F", "--position-lr-max-steps", default=RECIPE)
    ] = None
    """Step at which the learning rate of the positions reaches its final value. A value with a
    decimal point (1.0) is a fraction of all steps."""
    lr_log_scales: Annotated[float | None, flag("F", "--scaling-lr", default=RECIPE)] = None
    """Learning rate of the scales."""
    lr_quats: Annotated[float | None, flag("F", "--rotation-lr", default=RECIPE)] = None
    """Learning rate of the rotations."""
    lr_opacity_logits: Annotated[float | None, flag("F", "--opacity-lr", default=RECIPE)] = None
    """Learning rate of the opacities."""
    lr_sh_dc: Annotated[float | None, flag("F", default=RECIPE)] = None
    """Learning rate of the base colours."""
    lr_sh_rest: Annotated[float | None, flag("F", default=RECIPE)] = None
    """Learning rate of the view-dependent colours."""

    def config_settings(self) -> dict[str, Any]:
        """The settings that were given: name -> value."""
        given = {field.name: getattr(self, field.name) for field in fields(ConfigFlags)}
        if self.test_iterations is not None:
            given["test_iterations"] = tuple(step for step in self.test_iterations if step > 0)
        for name in ("abs_grad", "stop_overfitting", "antialias", "sky"):
            if given[name] is not None:
                given[name] = given[name] == "on"
        return {name: value for name, value in given.items() if value is not None}
