"""`TrainConfig`: the settings of a training run; changing them by name; storing them as JSON."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

from snowsplat.training.core.lr_schedule import LearningRates
from snowsplat.training.core.step_schedule import Schedule, When
from snowsplat.training.density import DENSITY_CONTROLS, AdaptiveDensity, DensityConfig
from snowsplat.training.parts.decay import DecayRates
from snowsplat.training.parts.transients import TransientsMode
from snowsplat.training.starts import STARTS
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.safe_json import from_json

if TYPE_CHECKING:
    from snowsplat.training.parts.part import Part

#: The generators are seeded with four times the seed, which has to fit into 64 bits.
_SEED_LIMIT = 2**61


@dataclass(frozen=True)
class TrainConfig:
    """All settings of a training run; the defaults are those of the paper.

    A moment (`When`) is a step (int) or a fraction of ``iterations`` (float).

    Attributes:
        iterations: number of steps; each step uses one view.
        batch: number of views per update of the Gaussians. All other settings still count steps,
            that is, views. The gradient of an update is the mean over the views of the batch; the
            learning rates are multiplied by √batch, and Adam's β₁ and β₂ are raised to the power
            batch (Zhao et al. 2024, arXiv:2406.18533).
        seed: seed of every random choice. On a CPU, the same seed results in a bit-identical scene,
            for any number of threads.
        background: the colour behind the scene; "random": a new colour in each step, which prevents
            fog in datasets with a transparent background.
        sh_degree: final degree of the spherical harmonics, 0 to 3.
        sh_interval: the degree in use begins at 0 and increases by one after this many steps; 0:
            use ``sh_degree`` from the first step.
        ssim_weight: λ of (1 − λ) · L1 + λ · D-SSIM.
        init: where the first Gaussians come from: names of `starts.STARTS`, joined by "+". If they
            find nothing, for example "points" in a dataset without points, "random" is used.
        initial_points: number of points of each start except "points", which uses all points of the
            dataset; a float is a share of the limit of Gaussians.
        initial_opacity: the opacity of every Gaussian at initialisation.
        initial_scale: the scale of every Gaussian at initialisation, in units of the mean distance
            to its three nearest neighbours.
        sky: whether the first Gaussians include some for the sky, if the photos show it; see `sky`.
        sky_distance: the distance of the sky from the middle of the cameras, in world units; 0: a
            hundred times the distance of the cameras from it.
        learning_rates: see `LearningRates`.
        decay: see `DecayRates`.
        relative_scale: largest scale of a Gaussian, in units of its distance to the nearest camera
            of a training view; see `scale_limit`. 0: no limit.
        near_limit: smallest depth of a Gaussian in a view, in units of that of the nearest points
            of the dataset; see `near_limit`. 0: no limit.
        density: settings of density control, one of `DENSITY_CONTROLS`.
        gaussians_per_pixel: limit of the number of Gaussians relative to the number of pixels of a
            photo, in addition to ``density.max_gaussians``. More Gaussians would not improve the
            scene. 0: no limit, and ``limit_views`` has no effect.
        limit_views: with more training views than this, the limit of Gaussians grows with the
            square root of their number, because they show a larger scene. 0: it does not grow.
        antialias: whether the scene is trained and rendered without aliasing in other resolutions
            than that of the photos: the 2D mip filter of `ops.project`, and the limit of the scales
            of `smoothing`.
        visible_only: whether the optimiser skips Gaussians that are not visible in the view of the
            step. In the paper, their momentum continues to change them. Skipping them is faster,
            without a measurable loss of quality.
        coarse_to_fine: until the first moment, images have a quarter of the resolution; until the
            second one, half of it; 0: never.
        leave_out_after: the moment after which training views are left out if the scene does not
            explain them, because their camera poses are probably wrong; see `unexplained`. 0:
            never.
        transients: whether what moves is masked in the photos, such as people who walk past; see
            `transients`. "auto": only with at least 30 views, eight steps for each view, and if
            something moves in several of them. "on" also delays densification until the first masks
            are known.
        stop_overfitting: whether the training ends earlier if the views between the photos become
            worse; see `overfitting`.
        exposure: whether a gain for each photo and channel is learnt, because the photos have
            different exposures; see `exposure`. "auto": if they differ by 0.05 EV or more.
        refine_poses: whether the poses and focal lengths of the training views are optimised,
            too; see `pose_refinement`.
        image_memory: bytes for decoded images, in each process; 0: half of the available memory,
            for all processes of the computer together.
        test_iterations: steps after which `Trainer.run` evaluates the test views.
        checkpoint_every: number of steps between two checkpoints; 0: none. The caller of
            `Trainer.run` writes them.

    Raises:
        SettingError: a value is invalid.
    """

    iterations: int = 30_000
    batch: int = 1
    seed: int = 0
    background: Literal["black", "white", "random"] = "black"
    sh_degree: int = 3
    sh_interval: int = 1000
    ssim_weight: float = 0.2
    init: str = "points"
    initial_points: int | float = 100_000
    initial_opacity: float = 0.1
    initial_scale: float = 1.0
    sky: bool = False
    sky_distance: float = 0.0
    learning_rates: LearningRates = field(default_factory=LearningRates)
    decay: DecayRates = field(default_factory=DecayRates)
    relative_scale: float = 0.0
    near_limit: float = 0.0
    density: DensityConfig = field(default_factory=AdaptiveDensity)
    gaussians_per_pixel: float = 0.0
    limit_views: int = 0
    antialias: bool = False
    visible_only: bool = False
    coarse_to_fine: tuple[When, When] = (0, 0)
    leave_out_after: When = 0
    transients: TransientsMode = "off"
    stop_overfitting: bool = False
    exposure: Literal["auto", "on", "off"] = "off"
    refine_poses: bool = False
    image_memory: int = 0
    test_iterations: tuple[int, ...] = (7_000, 30_000)
    checkpoint_every: int = 0

    def __post_init__(self) -> None:
        rates, density = self.learning_rates, self.density
        for name, count in (
            ("iterations", self.iterations),
            ("batch", self.batch),
            ("densify_interval", density.densify_interval),
        ):
            if count < 1:
                raise SettingError(name, f"{count} is too small; use at least 1")
        if self.sh_degree not in (0, 1, 2, 3):
            raise SettingError("sh_degree", f"{self.sh_degree} is not supported; use 0, 1, 2 or 3")
        if not -_SEED_LIMIT <= self.seed < _SEED_LIMIT:
            raise SettingError("seed", f"{self.seed} is too large; use one closer to 0")
        for name, rate in (("lr_means", rates.means), ("lr_means_final", rates.means_final)):
            if rate <= 0.0:  # the schedule interpolates the logarithms of the rates
                raise SettingError(name, f"{rate:g} is not positive; use e.g. 1e-12 instead of 0")
        for name, when in (
            ("densify_from", density.densify_from),
            ("densify_until", density.densify_until),
            ("lr_means_steps", rates.means_steps),
            ("decay_until", self.decay.until),
            ("leave_out_after", self.leave_out_after),
        ):
            if not math.isfinite(when):
                raise SettingError(name, f"{when} is not a step; use e.g. 500, or a fraction, 0.5")
        if not 0.0 < rates.anneal < math.inf:
            raise SettingError("lr_anneal", f"{rates.anneal:g} is not positive; use e.g. 0.1")
        if not 0.0 <= rates.anneal_from < 1.0:
            raise SettingError(
                "lr_anneal_from", f"{rates.anneal_from:g} is not a fraction; use e.g. 0.6"
            )
        for name, rate in (
            ("decay_opacity", self.decay.opacity),
            ("decay_scale", self.decay.scale),
        ):
            if not 0.0 <= rate < math.inf:
                raise SettingError(name, f"{rate:g} is not valid; use e.g. 0.04, or 0 for none")
        for name, limit in (
            ("relative_scale", self.relative_scale),
            ("near_limit", self.near_limit),
            ("sky_distance", self.sky_distance),
        ):
            if not 0.0 <= limit < math.inf:
                raise SettingError(name, f"{limit:g} is not valid; use e.g. 0.5, or 0 for none")
        for name in self.starts:
            if name not in STARTS:
                names = ", ".join(STARTS)
                raise SettingError("init", f"{name!r} does not exist; use one of {names}")
        share = isinstance(self.initial_points, float)
        if not (0.0 < self.initial_points <= 1.0 if share else self.initial_points >= 1):
            raise SettingError(
                "initial_points",
                f"{self.initial_points:g} is neither a number nor a share of the limit of "
                "Gaussians; use e.g. 20000 or 0.4",
            )
        if self.transients not in get_args(TransientsMode):
            raise SettingError("transients", f"{self.transients!r}: use auto, on or off")
        if self.leave_out_after < 0:
            raise SettingError(
                "leave_out_after", f"{self.leave_out_after} is negative; use 0 for never"
            )

    @property
    def starts(self) -> tuple[str, ...]:
        """The names in ``init``."""
        return tuple(self.init.split("+"))

    @property
    def points_per_start(self) -> int:
        """``initial_points`` as a number, at most the limit of Gaussians.

        Raises:
            SettingError: it is a share, but the number of Gaussians has no limit.
        """
        limit = self.density.max_gaussians
        if isinstance(self.initial_points, int):
            return min(self.initial_points, limit or self.initial_points)
        if not limit:
            raise SettingError(
                "initial_points", "is a share of the limit of Gaussians; set max_gaussians as well"
            )
        return max(1, round(self.initial_points * limit))

    def capped(self, pixels: int, views: int) -> TrainConfig:
        """This configuration with the limit of Gaussians for a dataset.

        The result has no ``gaussians_per_pixel``, so another call does not change it.

        Args:
            pixels: number of pixels of a photo.
            views: number of training views.
        """
        if self.gaussians_per_pixel <= 0:
            return self
        cap = self.gaussians_per_pixel * pixels
        if self.density.max_gaussians > 0:
            cap = min(cap, self.density.max_gaussians)
        if self.limit_views > 0:
            cap *= max(1.0, math.sqrt(views / self.limit_views))
        density = replace(self.density, max_gaussians=max(1, round(cap)))
        return replace(self, density=density, gaussians_per_pixel=0.0)

    def downscale_at(self, step: int, schedule: Schedule) -> int:
        """The factor by which images are reduced at this step: 1, 2 or 4."""
        quarter, half = (schedule.step_of(when) for when in self.coarse_to_fine)
        return 4 if step <= quarter else 2 if step <= half else 1

    def sh_degree_at(self, step: int) -> int:
        """The degree of the spherical harmonics in use at this step."""
        return min(self.sh_degree, step // self.sh_interval) if self.sh_interval else self.sh_degree


def parts_of(config: TrainConfig) -> list[Part]:
    """What takes part in a training with these settings, in order. This is the only list of parts.

    A new option is a field of `TrainConfig`, a part in its own file, and a line here.
    """
    # The settings can be read without the parts.
    from snowsplat.training.parts.decay import Decay
    from snowsplat.training.parts.densification import Densification
    from snowsplat.training.parts.exposure import Exposure
    from snowsplat.training.parts.near_limit import NearLimit
    from snowsplat.training.parts.overfitting import OverfittingCheck
    from snowsplat.training.parts.pose_refinement import PoseRefinement
    from snowsplat.training.parts.scale_limit import ScaleLimit
    from snowsplat.training.parts.sky import SkyPart
    from snowsplat.training.parts.smoothing import SmoothingFilter
    from snowsplat.training.parts.transients import Transients
    from snowsplat.training.parts.unexplained import Unexplained

    parts: list[tuple[bool, Part]] = [
        (config.exposure != "off", Exposure(config.exposure)),
        (config.leave_out_after > 0, Unexplained(config.leave_out_after)),
        (config.refine_poses, PoseRefinement()),
        (config.stop_overfitting, OverfittingCheck()),
        (config.transients != "off", Transients(config.transients)),
        (config.near_limit > 0, NearLimit(config.near_limit)),
        (config.sky, SkyPart(config.sky_distance)),
        (True, Densification(late=config.transients == "on")),
        (True, Decay(config.decay)),
        (config.relative_scale > 0, ScaleLimit(config.relative_scale)),
        (config.antialias, SmoothingFilter()),
    ]
    return [part for used, part in parts if used]


def changed(config: TrainConfig, **settings: Any) -> TrainConfig:
    """``config`` with other values for some settings, by name.

    Args:
        settings: fields of `TrainConfig`; fields of its density control (``grad_threshold=4e-4``);
            fields of `LearningRates` with the prefix ``lr_`` (``lr_means=1e-4``), and of
            `DecayRates` with the prefix ``decay_``. None leaves a setting unchanged.
            ``max_gaussians`` also disables ``gaussians_per_pixel``.

    Raises:
        SettingError: the configuration has no such setting, or a value is invalid.
    """
    given = {name: value for name, value in settings.items() if value is not None}
    if "max_gaussians" in given:
        given.setdefault("gaussians_per_pixel", 0.0)
    direct = {f.name for f in fields(config)} & given.keys()
    config = replace(config, **{name: given.pop(name) for name in direct})
    parts: dict[str, Any] = {}
    for part, prefix in (("density", ""), ("learning_rates", "lr_"), ("decay", "decay_")):
        settings_of = getattr(config, part)
        names = {f.name for f in fields(settings_of) if prefix + f.name in given}
        parts[part] = replace(settings_of, **{name: given.pop(prefix + name) for name in names})
    if given:
        raise SettingError(
            next(iter(given)),
            f"not a setting of {type(config.density).__name__}; remove it or use another recipe",
        )
    return replace(config, **parts)


def config_to_json(config: TrainConfig) -> dict[str, Any]:
    """The configuration as JSON values, for `config_from_json`."""
    return asdict(config) | {"density_control": type(config.density).__name__}


def config_from_json(values: dict[str, Any]) -> TrainConfig:
    """The configuration that `config_to_json` returned.

    Raises:
        UserError: written by another version of the program, or damaged.
    """
    try:
        values = dict(values)
        density = from_json(DENSITY_CONTROLS[values.pop("density_control")], values.pop("density"))
        rates = from_json(LearningRates, values.pop("learning_rates"))
        decay = from_json(DecayRates, values.pop("decay", {}))  # not in older files
        config = from_json(TrainConfig, values)
        return replace(config, density=density, learning_rates=rates, decay=decay)
    except (KeyError, TypeError, ValueError):
        raise UserError(
            "the configuration: written by another version of snowsplat; resume with that version"
        ) from None
