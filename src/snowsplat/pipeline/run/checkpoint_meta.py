"""`CheckpointMeta`: the data in a checkpoint that are not tensors: settings, recipe, time."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from snowsplat.pipeline.run.photo_stamps import Stamp
from snowsplat.project.training_folder import DatasetSettings
from snowsplat.training.settings.schedule import Schedule
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import from_json

if TYPE_CHECKING:
    from snowsplat.training.core.checkpoint import Checkpoint


@dataclass(frozen=True)
class CheckpointMeta:
    """The JSON object in a checkpoint; its keys are the names of the fields."""

    dataset: DatasetSettings  # how the dataset was read
    recipe: str  # the recipe from which the configuration was derived
    training: dict[str, Any]  # the configuration, see `config_to_json`
    time: dict[str, float] | None = None  # see `TimeBudget.as_json`; None without a time budget
    # The schedule, if it has changed: for a time budget.
    schedule: Schedule | None = None
    # Stamps of the photos and masks; None in checkpoints of earlier versions.
    photos: dict[str, Stamp] | None = None

    @classmethod
    def from_checkpoint(cls, start: Checkpoint) -> CheckpointMeta:
        """The checked data of the checkpoint ``start``, from which a training run resumes.

        Raises: UserError: not a checkpoint of a training run, or damaged.
        """
        try:
            meta = from_json(CheckpointMeta, dict(start.meta))
            if meta.time is not None and meta.time.keys() != {"seconds", "spent"}:
                raise ValueError("invalid time budget")
        except ValueError as error:
            raise UserError(
                "{path}: not a checkpoint of a training run ({error})", path=start.path, error=error
            ) from None
        return meta

    def as_json(self) -> dict[str, Any]:
        """The JSON value; fields that are None are left out."""
        return {key: value for key, value in asdict(self).items() if value is not None}
