"""`TrainConfig`: the settings of a training run."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from snowsplat.training.settings.density import AdaptiveDensity, DensityConfig, check_density
from snowsplat.training.settings.rates import DecayRates, LearningRates
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.settings.starts import check_starts
from snowsplat.util.errors import SettingError
from snowsplat.util.settings import Settings, When, flag, part, setting

#: Whether a part takes part: always, never, or if the photos show that it is needed.
AutoOnOff = Literal["auto", "on", "off"]

#: The generators are seeded with four times the seed, which has to fit into 64 bits.
_SEED_LIMIT = 2**61

# What changes if each photo is used half as often as `TrainConfig.few_passes` says, or less. Both
# are measured: see "few passes" in docs/performance.md.
#: What is added to the two moments of `TrainConfig.coarse_to_fine`, as shares of all steps: early
#: steps with small images are cheap looks at many photos.
_LATER_MOMENTS = (0.05, 0.1)
#: The number of further steps, as a share of the steps of the recipe.
_MORE_STEPS = 0.75


@dataclass(frozen=True)
class TrainConfig(Settings):
    """All settings of a training run; the defaults are those of the paper.

    A moment (`When`) is a step (int) or a fraction of ``iterations`` (float). See
    `snowsplat.training.settings.names.changed` for changing settings by name.

    Raises:
        SettingError: a value is invalid, or two settings contradict each other.
    """

    iterations: int = flag(30_000, "Number of training steps; each uses one photo.", least=1)
    # The gradient of an update is the mean over the views of the batch, and Adam's β₁ and β₂ are
    # raised to the power batch (Zhao et al. 2024, arXiv:2406.18533).
    batch: int = flag(
        1,
        "Number of photos per update of the Gaussians. All other settings still count photos; the "
        "learning rates are multiplied by the square root of N.",
        "1",
        least=1,
    )
    checkpoint_every: int = flag(
        0, "Save a checkpoint every N steps. `resume` can continue from it.", "none", least=0
    )
    seed: int = flag(
        0,
        "Seed of all random choices. On the CPU, the same seed produces a bit-identical scene; on "
        "a GPU, this requires `deterministic`.",
        "0",
        least=-_SEED_LIMIT,
        most=_SEED_LIMIT - 1,
        allowed="a whole number closer to 0 than 2**61",
    )
    test_iterations: tuple[int, ...] = flag(
        (7_000, 30_000),
        "Steps after which to evaluate the scene on the held-out photos, in addition to the last "
        "step; -1: only after the last step.",
        least=-1,
    )
    background: Literal["black", "white", "random"] = flag(
        "black",
        "Colour of the background of the scene and of transparent photos; random: a new colour in "
        "each step, which prevents fog before a transparent background.",
        "black",
    )
    leave_out_after: When = flag(
        0,
        "After this step, leave out the training photos that the scene does not explain: their "
        "camera poses are probably wrong. A value with a decimal point (0.15) is a fraction of all "
        "steps; 0: never.",
        "0",
        least=0,
    )
    transients: AutoOnOff = flag(
        "off",
        "Whether to mask what moves, such as people who walk past: it looks different from what "
        "the other photos show at this place. auto: if there are at least 30 photos and something "
        "moves in several of them; on: in any of at least 8 photos, and add Gaussians only after "
        "the first masks are known.",
    )
    exposure: AutoOnOff = flag(
        "off",
        "Whether to learn a gain for each photo and colour channel, for photos with different "
        "exposures or white balances. auto: if the photos differ by at least 0.05 EV.",
    )
    refine_poses: bool = setting(
        False,
        "Optimise the poses and focal lengths of the photos together with the scene, if they are "
        "not exact. The refined cameras are written to OUT/cameras.json and, as a COLMAP model, to "
        "OUT/refined/sparse/0.",
        metavar="",
    )
    antialias: bool = flag(
        False,
        "Whether to train a scene that also looks right in images that are smaller or larger than "
        "the photos. The scene file is marked. off: for viewers that draw as the reference "
        "implementation does, in images of the size of the photos.",
    )
    sh_degree: int = setting(
        3,
        "Degree of the spherical harmonics (view-dependent colour). A lower degree needs less "
        "memory.",
        "3",
        least=0,
        most=3,
        allowed="0, 1, 2 or 3",
        metavar="{0,1,2,3}",
    )
    sh_interval: int = setting(
        1000,
        "The degree in use begins at 0 and increases by one after this many steps; 0: use "
        "`sh_degree` from the first step.",
        least=0,
    )
    ssim_weight: float = flag(
        0.2,
        "Weight of 1 - SSIM in the loss. The mean absolute difference has the weight 1 - F.",
        least=0.0,
        most=1.0,
        aliases=("--lambda-dssim",),
    )
    huber_weight: float = flag(
        0.0,
        "Weight of a term of the loss that is the squared difference up to 0.1, and linear beyond; "
        "in the last 30% of the steps. It decreases the largest differences, which the PSNR counts "
        "most.",
        least=0.0,
    )
    huber_from: When = setting(0.7, "First moment of `huber_weight`.", least=0)
    beta1: float = flag(
        0.9,
        "Decay rate of Adam's mean of gradients, for a step with one view. Each step has another "
        "view, so with a smaller rate, fewer views share a step.",
        least=0.0,
        below=1.0,
    )
    depth_weight: float = flag(
        0.0,
        "Weight of the depth maps (depths/IMG.png) and normal maps (normals/IMG.png) of the "
        "dataset in the loss; 0: they are not used. Depths have any unit, normals are in the frame "
        "of the camera. A map that contradicts the points or the photos is left out.",
        "0",
        least=0.0,
    )
    surfaces: bool = flag(
        False,
        "Whether to train flat Gaussians that lie in the surfaces, for meshes and depths. The "
        "training takes about 1.3 times as long.",
    )
    init: str = setting(
        "points",
        "Where the first Gaussians come from. points: the points of the dataset; sweep: depth maps "
        "computed from the photos (plane sweep); depth: the depth maps of the dataset "
        "(depths/IMG.png); random: random depths of random pixels. Example: points+sweep.",
        allowed="names of starts, such as points+sweep",
        check=check_starts,
        metavar="START[+START…]",
    )
    initial_points: int | float = flag(
        100_000,
        "Number of points of each start except points, which uses all. A value with a decimal "
        "point (0.4) is a share of the maximum number of Gaussians.",
        above=0,
        allowed="a number such as 20000, or a share of the limit of Gaussians such as 0.4",
    )
    sweep_side: int = setting(
        640,
        "Maximum width and height of the depth maps of the start `sweep`, in pixels.",
        least=1,
    )
    initial_opacity: float = setting(
        0.1, "Opacity of every Gaussian at initialisation.", above=0.0, below=1.0
    )
    initial_scale: float = setting(
        1.0,
        "Scale of every Gaussian at initialisation, in units of the mean distance to its three "
        "nearest neighbours.",
        above=0.0,
    )
    sky: bool = flag(
        False,
        "Whether to start with Gaussians far behind the scene if the photos show the sky, and with "
        "none before it. The dataset needs points.",
    )
    sky_distance: float = flag(
        0.0,
        "Distance of these Gaussians from the middle of the cameras, in units of the scene.",
        "100 x the size of the path",
        least=0.0,
    )
    density: DensityConfig = part(
        AdaptiveDensity, "Settings of density control.", check=check_density
    )
    gaussians_per_pixel: float = setting(
        0.0,
        "Limit of the number of Gaussians relative to the number of pixels of a photo, in addition "
        "to `max_gaussians`; more would not improve the scene. 0: no limit, and `limit_views` has "
        "no effect.",
        least=0.0,
    )
    limit_views: int = setting(
        0,
        "With more training photos than this, the limit of Gaussians grows with the square root of "
        "their number, because they show a larger scene; 0: it does not grow.",
        least=0,
    )
    learning_rates: LearningRates = part(LearningRates, "Learning rates and their schedules.")
    decay: DecayRates = part(DecayRates, "Rates of the decay of opacities and scales.")
    relative_scale: float = setting(
        0.0,
        "Largest scale of a Gaussian, in units of its distance to the nearest camera of a training "
        "photo; 0: no limit.",
        least=0.0,
    )
    near_limit: float = setting(
        0.0,
        "Smallest depth of a Gaussian in a photo, in units of that of the nearest points of the "
        "dataset in this photo; 0: no limit.",
        least=0.0,
    )
    # In the paper, the momentum of Gaussians that are not visible continues to change them.
    # Skipping them is faster, without a measurable loss of quality.
    visible_only: bool = setting(
        False,
        "Whether the optimiser skips Gaussians that are not visible in the photo of the step.",
    )
    coarse_to_fine: tuple[When, When] = setting(
        (0, 0),
        "Until the first moment, images have a quarter of the resolution; until the second one, "
        "half of it; 0: never.",
        least=0,
    )
    few_passes: float = setting(
        0.0,
        "With fewer passes over the photos than this, images are reduced for longer, and a recipe "
        "has more steps; with half as many or fewer, by 0.05 and 0.1 of all steps, and half more "
        "steps. If `coarse_to_fine` is set, this is 0 unless it is set, too; 0: never.",
        least=0.0,
    )
    image_memory: int = setting(
        0,
        "Bytes for decoded images, in each process; 0: half of the available memory, for all "
        "processes of the computer together.",
        least=0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        # The relations between settings are checked here, and nowhere else.
        share = isinstance(self.initial_points, float)
        limited = self.density.max_gaussians or self.gaussians_per_pixel
        if share and not limited and (self.sky or self.starts != ("points",)):
            raise SettingError(
                "initial_points",
                "{initial_points:g} is a share of the limit of Gaussians; set max_gaussians as "
                "well",
                initial_points=self.initial_points,
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
        config = self.staged(views)
        if self.gaussians_per_pixel <= 0:
            return config
        cap = self.gaussians_per_pixel * pixels
        if self.density.max_gaussians > 0:
            cap = min(cap, self.density.max_gaussians)
        if self.limit_views > 0:
            cap *= max(1.0, math.sqrt(views / self.limit_views))
        density = replace(self.density, max_gaussians=max(1, round(cap)))
        return replace(config, density=density, gaussians_per_pixel=0.0)

    def lengthened(self, views: int) -> TrainConfig:
        """This configuration of a recipe, with more steps if ``views`` are used in few passes.

        Early steps with small images are cheap looks at many photos, so they are extended, too, as
        if the passes were as few as before. See docs/what-was-tried.md.
        """
        more = 1.0 + _MORE_STEPS * self._few(views)
        passes = more * self.few_passes
        return replace(self, iterations=round(more * self.iterations), few_passes=passes)

    def staged(self, views: int) -> TrainConfig:
        """This configuration with the moments of ``coarse_to_fine`` for this number of views.

        The result has no ``few_passes``, so another call does not change it. With 0 views, the
        result is unchanged.
        """
        if self.few_passes <= 0.0 or views == 0:
            return self
        few = self._few(views)
        quarter, half = (
            when + few * later if isinstance(when, float) else when
            for when, later in zip(self.coarse_to_fine, _LATER_MOMENTS, strict=True)
        )
        return replace(self, coarse_to_fine=(quarter, half), few_passes=0.0)

    def _few(self, views: int) -> float:
        """0 with ``few_passes`` over the photos or more, 1 with half as many or fewer."""
        ratio = self.few_passes * views / self.iterations
        return min(max(0.0, math.log2(ratio)), 1.0) if ratio > 0.0 else 0.0

    def downscale_at(self, step: int, schedule: Schedule) -> int:
        """The factor by which images are reduced at this step: 1, 2 or 4."""
        quarter, half = (schedule.step_of(when) for when in self.coarse_to_fine)
        return 4 if step <= quarter else 2 if step <= half else 1

    def sh_degree_at(self, step: int) -> int:
        """The degree of the spherical harmonics in use at this step."""
        return min(self.sh_degree, step // self.sh_interval) if self.sh_interval else self.sh_degree
