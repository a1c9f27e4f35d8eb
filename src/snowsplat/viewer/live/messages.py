"""The messages that the page sends, checked: any program can connect and send anything."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any, Literal

import torch

from snowsplat.util.safe_json import from_json, parse_json
from snowsplat.viewer.live.display import DisplaySettings, Mode, Pose

#: Maximum size of a message in bytes.
MAX_BYTES = 4 << 10
_MAX_SIDE = 16384  # pixels of a window
_LONGEST = 320, 2560  # limits of the longer side of an image, in pixels
_SCALE = 0.02, 1.0  # limits of the size of the Gaussians
_SHARE = 0.05, 0.95  # limits of the share of the time
# The norm of a quaternion is above this value and below its inverse.
_SMALL = 1e-9
_MAX_COORDINATE = 1e15  # computations in float32 are finite below it

_Vector = tuple[float, float, float]


@dataclass(frozen=True)
class View:
    """The camera of the page has moved, or its window has another size.

    Attributes:
        number: counted by the page; an image has the number of the view that it shows.
        quat: wxyz of world_from_cam; x right, y down, z forward.
        position: camera centre, world units.
        fov: vertical field of view, radians.
        width, height: of the window in pixels.
        photo: index of the photo from whose position it looks, if there is one.
    """

    number: int
    quat: tuple[float, float, float, float]
    position: _Vector
    fov: float
    width: int
    height: int
    photo: int | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.number < 1 << 32:
            raise ValueError("the number of a view is out of range")
        if not _SMALL < math.hypot(*self.quat) < 1.0 / _SMALL:
            raise ValueError("the quaternion of a view is not a rotation")
        if not math.hypot(*self.position) < _MAX_COORDINATE or not self.fov > 0.0:
            raise ValueError("the position or the field of view is out of range")
        if not (1 <= self.width <= _MAX_SIDE and 1 <= self.height <= _MAX_SIDE):
            raise ValueError("the size of a window is out of range")

    def pose(self) -> Pose:
        quat, position = (torch.tensor(v, dtype=torch.float64) for v in (self.quat, self.position))
        return Pose(quat, position, self.fov, self.width, self.height, self.number)


@dataclass(frozen=True)
class Display:
    """How the scene is displayed, see `DisplaySettings`; numbers are limited to their ranges.

    ``longest``: pixels of the longer side of an image while the camera does not move.
    """

    mode: Mode
    degree: int
    scale: float
    wipe: float
    longest: int
    crop: tuple[_Vector, _Vector] | None = None

    @property
    def longest_side(self) -> int:
        return int(_within(self.longest, *_LONGEST))

    def settings(self) -> DisplaySettings:
        return DisplaySettings(
            mode=self.mode,
            sh_degree=int(_within(self.degree, 0, 3)),
            scale=_within(self.scale, *_SCALE),
            crop=self.crop,
            wipe=_within(self.wipe, 0.0, 1.0),
        )


@dataclass(frozen=True)
class Shown:
    """The image of this number, and all before it, have arrived."""

    number: int


@dataclass(frozen=True)
class Thumbnails:
    """Asks for the first ``count`` thumbnails of photos that are read."""

    count: int


@dataclass(frozen=True)
class Training:
    """A button of the training."""

    do: Literal["pause", "resume", "step"]


@dataclass(frozen=True)
class Share:
    """The maximum share of the time for images while the scene trains, 0..1."""

    share: float

    def limited(self) -> float:
        return _within(self.share, *_SHARE)


@dataclass(frozen=True)
class Key:
    """Asks for the present camera, as an entry of a camera list."""


Message = View | Display | Shown | Thumbnails | Training | Share | Key
_KINDS: dict[str, type[Message]] = {
    "view": View,
    "display": Display,
    "shown": Shown,
    "thumbnails": Thumbnails,
    "training": Training,
    "share": Share,
    "key": Key,
}


def parse(text: str) -> Message:
    """A message of the page, JSON: an object with its fields, and its name as ``type``.

    Raises: ValueError: it is none.
    """
    if len(text) > MAX_BYTES:
        raise ValueError("too long")
    value = parse_json(text.encode())
    kind = value.pop("type", None) if isinstance(value, dict) else None
    if not isinstance(kind, str) or kind not in _KINDS:
        raise ValueError("no message of the page")
    return from_json(_KINDS[kind], value)


def to_json(message: dict[str, Any]) -> str:
    """A message to the page: numbers have few digits; those that JSON does not have are null."""
    return json.dumps(_plain(message))


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value


def _within(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
