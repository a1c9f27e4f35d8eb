"""What is known about level, north and scale of a dataset: an entry of sfm.json, and its words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.util.safe_json import from_json

#: The entry of the result of the stage "images" in sfm.json.
PLACEMENT = "placement"


@dataclass(frozen=True)
class Placement:
    """What the frame of a scene was found from, and how certain it is; errors are one sigma.

    In the frame of the scene, y points down. All fields can be stored as JSON.
    """

    up_from: list[str]  # what the up direction was found from, as text for users
    level_error: float  # degrees
    north: tuple[float, float, float] | None = None  # unit vector in the scene; None: unknown
    north_from: str | None = None
    north_error: float | None = None  # degrees
    metres_per_unit: float | None = None  # None: unknown
    scale_from: str | None = None
    scale_error: float | None = None  # relative
    position_error: float | None = None  # m, of a GPS position, horizontal
    # Latitude, longitude (degrees) and altitude (m) of the origin of the scene.
    origin: tuple[float, float, float] | None = None
    doubts: list[str] = field(default_factory=list)  # as text for users

    @property
    def is_metric(self) -> bool:
        """Whether a unit of the scene is a metre."""
        return self.metres_per_unit == 1.0

    def lines(self) -> list[str]:
        """Lines of text for users, without a full stop."""
        found = [f"level: from {' and '.join(self.up_from)}, to about {_short(self.level_error)}°"]
        if self.north is not None and self.north_from and self.north_error is not None:
            x, _, z = self.north
            turn = math.degrees(math.atan2(x, z)) % 360
            aligned = "+z is north, +x is east"
            other = f"{turn:.0f}° clockwise from +z, seen from above"
            found.append(
                f"north: {aligned if z > 1 - 1e-9 else other}; from {self.north_from}, to about "
                f"{_short(self.north_error)}°"
            )
        if self.metres_per_unit and self.scale_from and self.scale_error:
            unit = "1 unit is 1 m" if self.is_metric else f"1 unit is {self.metres_per_unit:.4g} m"
            gps = self.position_error
            typical = f" ({_short(gps)} m typical error)" if gps else ""
            found.append(
                f"metric: {unit}, scale from {self.scale_from}{typical}, to about "
                f"{_short(100 * self.scale_error)}%"
            )
        return found + [f"note: {doubt}" for doubt in self.doubts]


def placement_of(images: Mapping[str, Any]) -> Placement | None:
    """The placement in the result of the stage "images"; None if there is none, as in datasets of
    earlier versions, or if it is damaged."""
    try:
        return from_json(Placement, images.get(PLACEMENT))
    except (ValueError, AttributeError):
        return None


def read_placement(dataset: Path) -> Placement | None:
    """The placement of the dataset in a folder; None if `sfm` did not make it, or see above."""
    return placement_of(DatasetFolder(dataset).result("images"))


def _short(value: float) -> str:
    """One digit after the point below 10, and at least 0.1: errors are not known better."""
    return f"{value:.0f}" if value >= 10 else f"{max(value, 0.1):.1f}"
