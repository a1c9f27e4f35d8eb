"""`AnamorphOptions`: what one can set of an anamorph. It imports nothing slow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from snowsplat.util.settings import Settings, setting

#: Where the Gaussians lie: see `snowsplat.extras.anamorph.arrangement`.
Shape = Literal["cloud", "solid"]


@dataclass(frozen=True)
class AnamorphOptions(Settings):
    """How pictures become an anamorph.

    Raises:
        SettingError: a value is out of range.
    """

    shape: Shape = setting(
        "cloud",
        "cloud: discs that float in a cube; solid: steps of a pile of cubes, which can be printed.",
        metavar="{cloud,solid}",
    )
    cells: int = setting(
        128,
        "Number of Gaussians along a side of a picture.",
        "128",
        least=8,
        most=512,
        metavar="N",
    )
    size: int = setting(
        384, "Pixels along a side of a picture.", "384", least=32, most=2048, metavar="PIXELS"
    )
    steps: int = setting(400, "Number of training steps.", "400", least=0, metavar="N")
    seed: int = setting(0, "Seed of the random depths.", "0", metavar="N")
