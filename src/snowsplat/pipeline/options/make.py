"""`MakeOptions`: what one can set of `make`."""

from dataclasses import dataclass
from typing import Literal

from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options import common
from snowsplat.sfm.options import DatasetOptions
from snowsplat.training.settings.config import AutoOnOff, TrainConfig
from snowsplat.util.settings import Settings, flag, group, same, setting

Quality = Literal["draft", "normal", "best"]


def _every(text: str) -> int | None:
    """Raises ValueError: the text is neither a number from 2 on nor "none"."""
    if text == "none":
        return None
    if not text.isdecimal() or int(text) < 2:
        raise ValueError(f"{text!r} is not valid; use 2 or more, or none")
    return int(text)


@dataclass(frozen=True)
class MakeOptions(Settings):
    """Options of `make`.

    Attributes:
        minutes: see `make_plan` for the number of photos that are used.
        marker: in metres; None: there are none.

    Raises:
        SettingError: a value is invalid.
    """

    quality: Quality | None = flag(
        None,
        "draft: a quick preview; best: takes several times as long as normal. With `minutes`, the "
        "quality determines only the effort to estimate the camera poses; the training uses the "
        "remaining time.",
        "normal; with --minutes, chosen for this time",
    )
    minutes: float | None = common.minutes(
        "Finish within this time. If there are too many photos for this time, some of them are "
        "used, evenly spread by name. If an earlier run was interrupted, the time of its finished "
        "stages is not counted, and its training resumes with the time that remained."
    )
    memory: int | str | None = common.memory()
    hold_out: int | None = setting(
        8,
        "Hold out every N-th photo until the scene is evaluated. Then the scene is trained on all "
        "photos for a moment; the printed PSNR is that of the scene before.",
        least=2,
        allowed="2 or more, or none",
        parse=_every,
        metavar="{none,N}",
    )
    title: str | None = flag(
        None, "The name of the scene in its report and on its pages.", "the name of the input"
    )
    exposure: AutoOnOff = same(TrainConfig, "exposure", "auto")
    marker: float | None = same(DatasetOptions, "marker", None)
    compute: Compute = group(Compute, only=("device", "threads"))


@dataclass(frozen=True)
class Preset:
    """The settings at one quality. A size is the length of the longer side, in pixels."""

    photos: int  # the size to which photos are reduced when they are copied into the dataset
    side: int  # the size of the photos in training
    iterations: int  # steps of the training
    # max_gaussians, densify_interval: settings of the training; None: the value of the recipe.
    max_gaussians: int | None
    densify_interval: int | None
    # About the time of the training, of the test views and of the last part, and that of preparing
    # each photo, in seconds of one core of the reference machine of `sfm.cost`.
    training: float
    training_per_photo: float


PRESETS: dict[Quality, Preset] = {
    "draft": Preset(1600, 640, 1500, 60_000, 50, 130.0, 1.2),
    "normal": Preset(2400, 1000, 2000, None, None, 600.0, 1.5),
    "best": Preset(3200, 1600, 10_000, 250_000, None, 4600.0, 3.0),
}
