"""`TrainOptions`: what one can set of a training."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options import common
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.density import DENSITY_CONTROLS
from snowsplat.training.settings.names import changed
from snowsplat.training.settings.rates import DecayRates, LearningRates
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.errors import UserError
from snowsplat.util.settings import Settings, by_name, flag, group, setting, switch

if TYPE_CHECKING:
    from snowsplat.project.training_folder import DatasetSettings


@dataclass(frozen=True)
class TrainOptions(Settings):
    """Options of the training. None selects the value of the recipe or, in `resume`, that of the
    checkpoint.

        TrainOptions(hold_out=8, settings={"iterations": 7000, "max_gaussians": 200_000})

    Attributes:
        config: a complete configuration, in the place of a recipe.
        hold_out: hold out every ``hold_out``-th photo for testing, if the dataset has no split of
            its own; default: none.
        first_held_out: default: 0, as in the papers. There, the first photo of a walk is at its
            end, where the fewest photos show the scene.
        checkpoint_seconds: if ``settings`` does not contain checkpoint_every; default: no
            checkpoints.

    Raises:
        UserError: a value is invalid, or ``minutes`` is given together with iterations.
    """

    recipe: str | None = common.recipe(
        None,
        "Named configuration, which determines the defaults of the other settings. default: 2000 "
        "steps, designed for CPUs; classic: the default recipe of version 0.1; paper: the 30,000 "
        "steps of the paper; mcmc: 30,000 steps with a fixed maximum number of Gaussians; "
        "mcmc-short: the same in 3000 steps.",
    )
    config: TrainConfig | None = None
    settings: Mapping[str, Any] = by_name(
        TrainConfig, *DENSITY_CONTROLS.values(), LearningRates, DecayRates
    )
    minutes: float | None = common.minutes(
        "Finish within this time, including evaluation and saving. The number of steps, the size "
        "of the photos and the maximum number of Gaussians are chosen for this time, unless flags "
        "set them. With `resume`, this is the time for the remaining steps."
    )
    hold_out: int | None = common.hold_out(
        "Hold out every 8th photo (or the test split of the dataset), and evaluate the scene on "
        "these photos at the end."
    )
    first_held_out: int | None = setting(None, "Index of the first held-out photo.", least=0)
    test_list: Path | None = common.test_list()
    images: str | None = common.images()
    resolution: int | None = common.resolution("unchanged")
    memory: int | str | None = common.memory()
    trust_cameras: bool = switch(
        "Train even if the cameras of the dataset contradict its photos or points, or have an "
        "impossible lens."
    )
    compute: Compute = group(Compute)
    save_iterations: tuple[int, ...] = flag(
        (), "Steps after which to save the scene, in addition to the last step.", least=-1
    )
    checkpoint_seconds: float | None = setting(None, "Time between checkpoints.", least=0.0)
    last_part: float = setting(
        0.0, "Steps that follow, relative to those of the training; for the time left.", least=0.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.minutes is not None and self.iterations is not None:
            raise UserError("`minutes` and `iterations` cannot be combined; set one of them")
        if self.recipe is not None and self.config is not None:
            raise UserError("`recipe` and `config` both contain all settings; leave one out")

    def configuration(self) -> TrainConfig:
        """The configuration with the changed settings.

        Raises:
            SettingError: a setting is unknown or invalid.
        """
        return changed(self.config or recipe(self.recipe or "default"), **self.settings)

    @property
    def iterations(self) -> int | None:
        """The requested number of steps."""
        return self.settings.get("iterations")

    def dataset_settings(
        self, dataset: Path | str | None, before: DatasetSettings | None = None
    ) -> DatasetSettings:
        """How to read the dataset: ``before`` with the changes of these options."""
        from snowsplat.project.training_folder import DatasetSettings

        every = 8 if self.hold_out is None and self.test_list is not None else self.hold_out
        changes: dict[str, Any] = {
            "path": None if dataset is None else str(Path(dataset).absolute()),
            "images": self.images,
            "resolution": self.resolution,
            "hold_out": every,
            "first_held_out": self.first_held_out,
            "test_list": None if self.test_list is None else str(Path(self.test_list).absolute()),
        }
        settings = before or DatasetSettings(path="")
        return replace(settings, **{k: v for k, v in changes.items() if v is not None})
