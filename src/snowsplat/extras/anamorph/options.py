"""`AnamorphOptions`: what one can set of an anamorph. It imports nothing slow."""

from dataclasses import dataclass
from typing import Literal

from snowsplat.util.settings import Settings, flag, setting

#: Where the Gaussians lie: see `snowsplat.extras.anamorph.arrangement`.
Shape = Literal["cloud", "solid"]


@dataclass(frozen=True)
class AnamorphOptions(Settings):
    """How pictures become an anamorph.

    Raises:
        SettingError: a value is out of range.
    """

    shape: Shape = flag(
        "cloud",
        "cloud: discs that float in a cube; solid: steps of a pile of cubes, which can be printed.",
    )
    cells: int = flag(
        128, "Number of Gaussians along a side of a picture.", "128", least=8, most=512
    )
    size: int = setting(
        384, "Pixels along a side of a picture.", "384", least=32, most=2048, metavar="PIXELS"
    )
    steps: int = flag(400, "Number of training steps.", "400", least=0)
    seed: int = flag(0, "Seed of the random depths.", "0")
