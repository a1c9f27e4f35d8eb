"""The messages that the page sends, checked: any program can connect and send anything."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any, Literal

from snowsplat.util.safe_json import from_json, parse_json
from snowsplat.viewer.live.display import Display, View, within

#: Maximum size of a message in bytes.
MAX_BYTES = 4 << 10
_SHARE = 0.05, 0.95  # limits of the share of the time


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
    """The maximum share of the time for images while the scene trains, limited to 0.05..0.95."""

    share: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "share", within(self.share, *_SHARE))


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
