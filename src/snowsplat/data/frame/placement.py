"""What is known about level, north and scale of a dataset: an entry of sfm.json, and its words."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.util.messages import Message, message
from snowsplat.util.names import all_names
from snowsplat.util.safe_json import from_json

#: The entry of the result of the stage "images" in sfm.json.
PLACEMENT = "placement"


@dataclass(frozen=True)
class Placement:
    """What the frame of a scene was found from, and how certain it is; errors are one sigma.

    In the frame of the scene, y points down. All fields can be stored as JSON.
    """

    up_from: list[Message]  # what the up direction was found from, as text for users
    level_error: float  # degrees
    north: tuple[float, float, float] | None = None  # unit vector in the scene; None: unknown
    north_from: Message | None = None
    north_error: float | None = None  # degrees
    metres_per_unit: float | None = None  # None: unknown
    scale_from: Message | None = None
    scale_error: float | None = None  # relative
    position_error: float | None = None  # m, of a GPS position, horizontal
    # Latitude, longitude (degrees) and altitude (m) of the origin of the scene.
    origin: tuple[float, float, float] | None = None
    doubts: list[Message] = field(default_factory=list)  # as text for users

    @property
    def is_metric(self) -> bool:
        """Whether a unit of the scene is a metre."""
        return self.metres_per_unit == 1.0

    def rows(self) -> list[tuple[Message, Message]]:
        """What is known, for users: pairs of its name and a clause about it."""
        error = _short(self.level_error)
        found = [
            (
                message("level"),
                message(
                    "from {evidence}, to about {error}°",
                    evidence=all_names(self.up_from),
                    error=error,
                ),
            )
        ]
        if self.north is not None and self.north_from and self.north_error is not None:
            x, _, z = self.north
            where = message("+z is north, +x is east")
            if z <= 1 - 1e-9:
                turn = math.degrees(math.atan2(x, z)) % 360
                where = message("{turn:.0f}° clockwise from +z, seen from above", turn=turn)
            about = message(
                "{where}; from {evidence}, to about {error}°",
                where=where,
                evidence=self.north_from,
                error=_short(self.north_error),
            )
            found.append((message("north"), about))
        if self.metres_per_unit and self.scale_from and self.scale_error:
            gps = self.position_error
            typical = message(" ({error} m typical error)", error=_short(gps)) if gps else ""
            about = message(
                "1 unit is {metres:.4g} m, scale from {evidence}{typical}, to about {error}%",
                metres=self.metres_per_unit,
                evidence=self.scale_from,
                typical=typical,
                error=_short(100 * self.scale_error),
            )
            found.append((message("metric"), about))
        return found + [(message("note"), doubt) for doubt in self.doubts]

    def lines(self) -> list[str]:
        """`rows` as lines of text without a full stop, in the language of the program."""
        return [
            str(message("{name}: {clause}", name=name, clause=clause))
            for name, clause in self.rows()
        ]


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
