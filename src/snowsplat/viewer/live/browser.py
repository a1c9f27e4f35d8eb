"""One browser that shows the page: receives its messages, checked, and sends images and states."""

from __future__ import annotations

import asyncio
import json
import logging
import math
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from starlette.websockets import WebSocket, WebSocketDisconnect

from snowsplat.util.safe_json import from_json, parse_json
from snowsplat.viewer.live.photos import Photos
from snowsplat.viewer.live.pictures import Display, View, within
from snowsplat.viewer.live.session import Visitor

_KEYS = 8  # cameras that a browser may ask for before it receives the first one
_IMAGE, _THUMBNAIL = 0, 1
# Before a JPEG: its kind; the number of the image and of the view that it shows, or the index of
# the photo of which it is the thumbnail.
_HEAD = struct.Struct("<BxxxII")

_log = logging.getLogger(__name__)
#: Maximum size of a message in bytes.
MAX_BYTES = 4 << 10
_SHARE = 0.05, 0.95  # limits of the share of the time


class Browser:
    """The connection to one browser. All methods run in the thread of the server.

    A browser that does not receive what it is sent costs little memory: a newer state replaces an
    older one of its type, and few images are on the way (`Session`).
    """

    def __init__(self, socket: WebSocket, visitor: Visitor, photos: Photos) -> None:
        self.visitor = visitor
        self._told: dict[str, str] = {}  # the newest message of each type that was not sent yet
        self.reading: asyncio.Task[None] | None = None  # reads the photo at which the browser is
        self._socket, self._photos = socket, photos
        self._images: deque[bytes] = deque()
        self._keys: deque[str] = deque()
        self._thumbnails = self._wanted = 0  # numbers of thumbnails that were sent, and asked for
        self._sent = self._arrived = 0  # numbers of images
        self._news = asyncio.Event()
        self._sending = asyncio.Lock()

    def tell(self, kind: str, text: str) -> None:
        """Send a message of this type, as JSON, in place of an unsent one of the same type."""
        self._told[kind] = text
        self.wake()

    def tell_key(self, entry: dict[str, Any]) -> None:
        """Send an entry of a camera list, if the browser receives what it has asked for."""
        if len(self._keys) < _KEYS:
            self._keys.append(json.dumps({"type": "key", "entry": entry}))
            self.wake()

    def show(self, jpeg: bytes, view: int) -> None:
        """Send an image of the view of this number."""
        self._sent += 1
        self._images.append(_HEAD.pack(_IMAGE, self._sent, view) + jpeg)
        self.wake()

    def wake(self) -> None:
        """Send what is new."""
        self._news.set()

    def want_thumbnails(self, count: int) -> None:
        """Send so many thumbnails. If it were all, images would wait for them on a slow link."""
        self._wanted = count
        self.wake()

    def arrived(self, number: int) -> int:
        """How many images have arrived if that of this number is the last of them."""
        images = max(0, min(number, self._sent) - self._arrived)
        self._arrived += images
        return images

    async def run(self, take: Callable[[Message], None]) -> None:
        """Send and receive until the browser disconnects; ``take`` gets its messages."""
        sender = asyncio.create_task(self._send())
        try:
            await self._receive(take)
        except (WebSocketDisconnect, OSError):
            pass
        finally:
            sender.cancel()

    async def _receive(self, take: Callable[[Message], None]) -> None:
        while True:
            received = await self._socket.receive()
            if received["type"] == "websocket.disconnect":
                return
            # Messages of a browser that does not receive what it is sent are not read.
            async with self._sending:
                pass
            text = received.get("text")
            try:
                message = parse(text) if isinstance(text, str) else None
            except ValueError as error:
                _log.debug("a message was ignored: %s", error)
                continue
            if message is not None:
                take(message)

    async def _send(self) -> None:
        try:
            while True:
                await self._news.wait()
                self._news.clear()
                while (content := self._next()) is not None:
                    async with self._sending:
                        if isinstance(content, str):
                            await self._socket.send_text(content)
                        else:
                            await self._socket.send_bytes(content)
        except (WebSocketDisconnect, OSError, RuntimeError) as error:
            _log.debug("a browser has disconnected: %s", error)

    def _next(self) -> str | bytes | None:
        """What to send next: states, then images, then thumbnails."""
        for kind in self._told:
            return self._told.pop(kind)
        if self._keys:
            return self._keys.popleft()
        if self._images:
            return self._images.popleft()
        if self._thumbnails < min(self._wanted, len(self._photos.thumbnails)):
            index, jpeg = self._photos.thumbnails[self._thumbnails]
            self._thumbnails += 1
            return _HEAD.pack(_THUMBNAIL, index, 0) + jpeg
        return None


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
