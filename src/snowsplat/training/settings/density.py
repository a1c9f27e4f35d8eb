"""The settings of density control, which adds and removes Gaussians; their registered names.

A density control has two dataclasses: its settings, here, and its state, in
`snowsplat.training.density`. Settings from outside of the package have a method that creates their
state, see `density_control` there. They can be used as they are,
``TrainConfig(density=MyDensity())``. To resume such a training from a checkpoint, the class is
registered:

    @register_density
    @dataclass(frozen=True)
    class MyDensity(DensitySettings): ...
"""

from dataclasses import dataclass, fields, is_dataclass
from typing import Any, ClassVar, Protocol, TypeVar

from snowsplat.util.settings import Settings, When, checked, declarations, flag, same, setting

_Kind = TypeVar("_Kind", bound=type)


class DensityConfig(Protocol):
    """The settings of a density control: a frozen dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def max_gaussians(self) -> int:
        """Maximum number of Gaussians, including the initial ones; 0: no limit."""
        ...

    @property
    def abs_grad(self) -> bool:
        """Whether `DensityControl.after_backward` uses ``gradient.splats.abs_grad``."""
        ...

    @property
    def densify_from(self) -> When:
        """The first step at which Gaussians may be added (float: fraction of all steps)."""
        ...

    @property
    def densify_until(self) -> When:
        """The last step at which Gaussians may be added (float: fraction of all steps)."""
        ...

    @property
    def densify_interval(self) -> int:
        """Number of steps between two densifications."""
        ...


@dataclass(frozen=True)
class AdaptiveDensity(Settings):
    """Adaptive density control; the defaults are those of the paper. See `density.adaptive`."""

    max_gaussians: int = flag(
        0,
        "Maximum number of Gaussians, which determines memory and time; 0: no limit. If it would "
        "be exceeded, only the Gaussians with the largest gradients are densified.",
        least=0,
    )
    # Gradients of opposite directions cancel in the sum of the paper, so a large Gaussian in a
    # detailed region is not split; see AbsGS (Ye et al. 2024). Sums of absolute values over pixels,
    # as in AbsGS, are larger and need a larger threshold; sums over tiles do not.
    grad_threshold: float = flag(
        2e-4,
        "Clone or split Gaussians whose view-space gradient exceeds this threshold. With a larger "
        "value, fewer Gaussians are added.",
        least=0.0,
        aliases=("--densify-grad-threshold",),
    )
    abs_grad: bool = flag(
        False,
        "Whether `grad_threshold` applies to the sum of the absolute gradients of the 16x16 tiles "
        "of the image. In this sum, gradients of opposite directions do not cancel, so more "
        "Gaussians are cloned or split in detailed regions.",
    )
    densify_interval: int = flag(
        100,
        "Number of steps between densifications. With a larger value, fewer Gaussians are added.",
        least=1,
        aliases=("--densification-interval",),
    )
    densify_from: When = flag(
        500,
        "First step of densification. A value with a decimal point (0.1) is a fraction of all "
        "steps.",
        least=0,
        aliases=("--densify-from-iter",),
    )
    densify_until: When = flag(
        15_000,
        "Last step of densification. A value with a decimal point (0.5) is a fraction of all "
        "steps.",
        least=0,
        aliases=("--densify-until-iter",),
    )
    opacity_reset_interval: int = flag(
        3000,
        "Number of steps between opacity resets; 0: no resets. The last one is at least 500 steps "
        "before densification ends.",
        least=0,
    )
    percent_dense: float = flag(
        0.01,
        "Densification clones Gaussians smaller than this fraction of the scene extent, and splits "
        "larger ones.",
        least=0.0,
    )
    prune_opacity: float = setting(
        0.005, "Gaussians with a lower opacity are removed.", least=0.0, below=1.0
    )
    # A forward-facing scene has a small extent compared to its depth, so that most of its Gaussians
    # would be removed.
    prune_world_size: float = setting(
        0.1,
        "Gaussians with a larger scale, in units of the scene extent, are removed; 0 disables "
        "this. Pruning by size begins after step `opacity_reset_interval`; if that is 0, never.",
        least=0.0,
    )
    prune_screen_size: float = setting(
        20.0,
        "Gaussians with a larger 3σ radius, in pixels, are removed; 0 disables this.",
        least=0.0,
    )
    # Most random points lie in empty space, where they get the colour of the background instead of
    # becoming transparent. Without the reset, 100,000 of them can remain as a cloud of that colour.
    reset_random_start: bool = setting(
        True,
        "Whether to reset opacity also at `densify_from`, if training started from random points "
        "and at least 500 steps are left.",
    )


@dataclass(frozen=True)
class DensitySettings(Settings):
    """A base class for the settings of another density control: what each of them has."""

    max_gaussians: int = same(AdaptiveDensity, "max_gaussians", 0)
    abs_grad: bool = same(AdaptiveDensity, "abs_grad", False)
    densify_interval: int = same(AdaptiveDensity, "densify_interval", 100)
    densify_from: When = same(AdaptiveDensity, "densify_from", 0)
    densify_until: When = same(AdaptiveDensity, "densify_until", 1.0)


@dataclass(frozen=True)
class McmcDensity(Settings):
    """MCMC density control; the defaults are those of its paper. See `density.mcmc`."""

    abs_grad: ClassVar[bool] = False  # there are no statistics of gradients

    max_gaussians: int = same(
        AdaptiveDensity,
        "max_gaussians",
        1_000_000,
        help="Maximum number of Gaussians.",
        least=1,
        allowed="a whole number of at least 1, because MCMC density control needs a limit",
    )
    densify_interval: int = same(AdaptiveDensity, "densify_interval", 100)
    densify_from: When = same(AdaptiveDensity, "densify_from", 500)
    densify_until: When = same(AdaptiveDensity, "densify_until", 25_000)
    growth: float = setting(
        0.05,
        "Fraction by which the number of Gaussians grows at each relocation, up to the limit.",
        least=0.0,
    )
    prune_opacity: float = setting(
        0.005,
        "Gaussians of this opacity or less are dead; they are relocated.",
        least=0.0,
        below=1.0,
    )
    noise: float = setting(
        5e5, "Scale of the noise on the positions, in units of their learning rate.", least=0.0
    )
    noise_until: When = setting(1.0, "Last step with noise.", least=0)
    opacity_regularizer: float = setting(0.01, "Weight of the mean opacity in the loss.", least=0.0)
    scale_regularizer: float = setting(0.01, "Weight of the mean scale in the loss.", least=0.0)


#: The settings class of every density control, by its name. Checkpoints contain this name.
DENSITY_CONTROLS: dict[str, type[DensityConfig]] = {
    "AdaptiveDensity": AdaptiveDensity,
    "McmcDensity": McmcDensity,
}


def register_density(kind: _Kind) -> _Kind:
    """Add a settings class to `DENSITY_CONTROLS`, under its name; usable as a decorator."""
    DENSITY_CONTROLS[kind.__name__] = kind
    return kind


#: What the trainer reads of every density control.
_REQUIRED = ("max_gaussians", "abs_grad", "densify_from", "densify_until", "densify_interval")


def check_density(density: Any) -> str | None:
    """What is wrong with the settings of a density control; None: nothing.

    Raises: SettingError: one of the settings that all density controls have is invalid.
    """
    if isinstance(density, type) or not is_dataclass(density):
        return "is not an object of a dataclass; use e.g. AdaptiveDensity()"
    own = () if isinstance(density, (AdaptiveDensity, McmcDensity)) else ("control",)
    missing = [name for name in (*_REQUIRED, *own) if not hasattr(density, name)]
    if missing:
        return f"has no {missing[0]}; see DensityConfig"
    if not isinstance(density, Settings):  # a plain dataclass has not checked its values
        for name, hint, declared in declarations(AdaptiveDensity):
            if name in _REQUIRED:
                checked(name, getattr(density, name), hint, declared)
    return None


def owner(name: str) -> str | None:
    """The name of a registered density control that has the setting ``name``."""
    for kind in DENSITY_CONTROLS.values():
        if name in {each.name for each in fields(kind)}:
            return kind.__name__
    return None
