"""The true scale of a scene from a known distance, between two points or two photos of it."""

import math
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from snowsplat.pipeline.output.scene_source import cameras_of, change_of
from snowsplat.project.project import Project
from snowsplat.scene.geometry import Similarity
from snowsplat.scene.length import metres_of
from snowsplat.util.errors import SettingError
from snowsplat.util.messages import Message, as_message, message
from snowsplat.util.safe_json import quoted

_EXAMPLE = "0,0.5,2 for a point, or the name of a photo"


@dataclass(frozen=True)
class KnownDistance:
    """A distance that a person has measured.

    Attributes:
        length: as text with a unit, such as "0.45m"; see `metres_of`.
        between: what it is between: two points "X,Y,Z" in the world of the scene, in the frame of
            a PLY, or the names of two photos, with or without suffix.

    Raises: SettingError: the length is none, or the two are the same.
    """

    length: str
    between: tuple[str, str]

    def __post_init__(self) -> None:
        try:
            metres_of(self.length)
        except ValueError as error:
            raise SettingError("scale_to", as_message(error)) from None
        if not all(self.between):
            raise SettingError(
                "scale_to", "between what? add `between` A B, each {example}", example=_EXAMPLE
            )
        if self.between[0] == self.between[1]:
            raise SettingError(
                "between", "{between} twice; use two different places", between=self.between[0]
            )

    def metres_per_unit(self, scene: Project) -> float:
        """The true length of a unit of the world of ``scene``.

        Raises:
            SettingError: a photo is not known, or the two places are the same.
            UserError: the list of the cameras is damaged.
        """
        a, b = (_point(text) for text in self.between)
        if a is None or b is None:
            # In the world of the file of the scene, which may be edited.
            names, cameras = cameras_of(scene.original.training)
            change = change_of(scene.edit) if scene.edit else Similarity.identity()
            places = [change.apply(camera.position).numpy() for camera in cameras]
            photos = dict(zip(names, places, strict=True))
            a = _photo(self.between[0], photos) if a is None else a
            b = _photo(self.between[1], photos) if b is None else b
        distance = float(np.linalg.norm(a - b))
        # The digits that a person writes, and poses, do not tell nearer places apart.
        if distance <= 1e-6 * max(np.abs(a).max(), np.abs(b).max()):
            raise SettingError(
                "between", "the two are at the same place; use two that are far apart"
            )
        return metres_of(self.length) / distance


def _point(text: str) -> np.ndarray | None:
    """(3,) the point that ``text`` states; None if it is not three numbers."""
    try:
        point = np.array([float(part) for part in text.split(",")])
    except ValueError:
        return None
    return point if point.shape == (3,) and np.isfinite(point).all() else None


def _photo(name: str, photos: dict[str, np.ndarray]) -> np.ndarray:
    if not photos:
        raise SettingError(
            "between",
            "{name} is no point, and the photos of this file are not known; use {example} of an "
            "output folder",
            name=quoted(name),
            example=_EXAMPLE,
        )
    wanted = str(PurePosixPath(name).with_suffix("")) if PurePosixPath(name).suffix else name
    found = photos.get(name, photos.get(wanted))
    if found is None:
        first = quoted(next(iter(photos)))
        raise SettingError(
            "between",
            "{name} is neither a point nor one of {photos} photos ({first} …); use {example}",
            name=quoted(name),
            photos=len(photos),
            first=first,
            example=_EXAMPLE,
        )
    return found


def compared(metres: float, before: float | None) -> Message:
    """A line about the scale that a scene gets, beside the one that it had."""
    line = message(
        "true scale: 1 unit was {metres:.6g} m; 1 unit of the written scene is 1 m", metres=metres
    )
    if before is None:
        return line
    percent = 100 * abs(math.expm1(math.log(metres / before)))
    if metres > before:
        return message("{line}; {percent:.2g}% more than before", line=line, percent=percent)
    return message("{line}; {percent:.2g}% less than before", line=line, percent=percent)
