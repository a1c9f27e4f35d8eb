"""`Edits`: how `convert` changes a scene."""

from __future__ import annotations

import re
from dataclasses import dataclass

from snowsplat.util.errors import SettingError
from snowsplat.util.settings import Settings, setting

Vector = tuple[float, float, float]
Box = tuple[float, float, float, float, float, float]

_UNITS = {"kb": 1000, "mb": 1000**2, "gb": 1000**3}


def gaussians_to_keep(decimate: int | str, count: int) -> int:
    """How many of ``count`` Gaussians a number (5000, "5000") or a percentage ("50%") keeps.

    Raises: SettingError: ``decimate`` is neither.
    """
    text = str(decimate)
    if re.fullmatch(r"\d+", text):
        return int(text)
    match = re.fullmatch(r"(\d+(?:\.\d+)?)%", text)
    if not match or float(match[1]) > 100:
        raise SettingError(
            "decimate",
            "{text!r} is not valid; use a number, 0% to 100%, or a size such as 10MB",
            text=text,
        )
    return round(count * float(match[1]) / 100)


def file_size(decimate: int | str | None) -> int | None:
    """The bytes that a size such as "10MB", "0.5 GB" or "800KB" stands for; None: not a size."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?([kmg]b)", str(decimate).lower())
    return round(float(match[1]) * _UNITS[match[2]]) if match else None


@dataclass(frozen=True)
class Edits(Settings):
    """Changes to a scene. The frame is that of a PLY: x right, y down, z forward.

    Attributes:
        crop: x, y, z of the lower corner and x, y, z of the upper corner.

    Raises:
        UserError: a value out of its range.
    """

    sh_degree: int | None = setting(
        None,
        "Reduce the spherical harmonics (view-dependent colour) to this degree, 0 to 3.",
        "that of the scene",
        least=0,
        most=3,
        allowed="0 to 3",
        metavar="N",
    )
    crop: Box | None = setting(
        None,
        "Keep only the Gaussians whose centres are in this box.",
        "all",
        metavar="X0 Y0 Z0 X1 Y1 Z1",
    )
    decimate: int | str | None = setting(
        None,
        "Number or percentage of Gaussians, or the size of FILE, e.g. 10MB. Neighbours are merged.",
        "all",
        parse=str,
        metavar="N|P%|SIZE",
    )
    rotate: Vector = setting(
        (0.0, 0.0, 0.0),
        "Rotate by these angles in degrees, first about x, then about y, then about z.",
        metavar="X Y Z",
    )
    scale: float = setting(
        1.0,
        "Scale by this factor about the origin.",
        above=0.0,
        allowed="a number above 0",
        metavar="F",
    )
    translate: Vector = setting((0.0, 0.0, 0.0), "Translate by this offset.", metavar="X Y Z")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.crop and any(
            low > high for low, high in zip(self.crop[:3], self.crop[3:], strict=True)
        ):
            raise SettingError("crop", "the corners are swapped; give the lower corner first")
        if self.decimate is not None and file_size(self.decimate) is None:
            gaussians_to_keep(self.decimate, 0)
