"""`BenchmarkOptions`, `PlanOptions`: what one can set of `benchmark` and of `plan_blocks`."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from snowsplat.pipeline.options import common
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.density import DENSITY_CONTROLS
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.settings import Settings, by_name, flag, setting

SuiteName = Literal["mipnerf360", "tandt", "db", "blender", "custom"]
#: More blocks than this are a mistake.
MOST_BLOCKS = 10_000


@dataclass(frozen=True)
class BenchmarkOptions(Settings):
    """Options of a benchmark.

    Attributes:
        suite: a name of `suites.SUITES`; None: that to which all scenes belong, or "custom".
        scenes: empty: all.
        settings: changed settings, see `TrainOptions`.

    Raises:
        UserError: an unknown suite, or fewer than 1 job.
    """

    suite: SuiteName | None = flag(None, "The benchmark suite.", "by the names of the scenes")
    scenes: tuple[str, ...] = setting((), "Only these scenes.", "all", metavar="[NAME ...]")
    recipe: str = common.recipe("default", "The recipe of the training.")
    settings: Mapping[str, Any] = by_name(
        TrainConfig, *DENSITY_CONTROLS.values(), only=("iterations", "max_gaussians")
    )
    resolution: int | None = common.resolution("set by the suite")
    lpips: Path | None = setting(
        None,
        "Network for LPIPS, or a file with its weights, see snowsplat evaluate.",
        "not measured",
        metavar="{vgg,alex,FILE}",
    )
    jobs: int = flag(
        1,
        "Number of scenes trained at the same time. They share the CPU; job i uses GPU i.",
        least=1,
    )
    device: Literal["cpu", "cuda"] | None = flag(None, "Device for the training.", "a GPU")

    def __post_init__(self) -> None:
        super().__post_init__()
        recipe(self.recipe, **self.settings)  # raises an error if a setting is invalid


@dataclass(frozen=True)
class PlanOptions(Settings):
    """Options of `plan_blocks`. None selects the value of the recipe or of `load_dataset`.

    Attributes:
        settings: changed settings, see `TrainOptions`. ``max_gaussians`` is the number of the whole
            scene, which the blocks share.
        images, resolution, hold_out, test_list: see `TrainOptions`. Photos that are held out are in
            no block.

    Raises:
        UserError: a value out of its range.
    """

    blocks: int = flag(4, "Number of blocks.", least=1, most=MOST_BLOCKS)
    margin: float = flag(
        0.2,
        "A block is trained with the photos and points of its cell, expanded on each side by this "
        "share of its size.",
        least=0.0,
        most=10.0,
    )
    recipe: str = common.recipe("default", "The recipe of the training, see snowsplat train.")
    settings: Mapping[str, Any] = by_name(
        TrainConfig,
        *DENSITY_CONTROLS.values(),
        only={
            "iterations": "Number of training steps of each block.",
            "max_gaussians": "Maximum number of Gaussians of the whole scene, which the blocks "
            "share; 0: no limit.",
        },
    )
    images: str | None = common.images()
    resolution: int | None = common.resolution("unchanged")
    hold_out: int | None = common.hold_out(
        "Hold out every 8th photo of the whole (or the test split of the dataset). No block is "
        "trained with them, and snowsplat evaluate OUT uses them."
    )
    test_list: Path | None = common.test_list()
