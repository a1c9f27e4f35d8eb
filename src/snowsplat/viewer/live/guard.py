"""Checks requests and messages of browsers to the live viewer, and limits their number and cost.

viser accepts every connection, trusts all messages and processes any number of them, in the process
that trains. Therefore `Guard.serve` starts viser's server with additional checks:

- The Host and Origin headers of a request must be those of this server. The path must begin with a
  secret token: other users of this machine can connect, too.
- The numbers of connections, page downloads and browsers are limited.
- Messages must be of the four types that the page sends, with finite numbers. A connection that
  sends more messages than a page can send is closed. If a client does not read the data that the
  server sends, the server reads no further messages of this client.
- During training, the server may use at most a fifth of a processor core.

It also tells when an image has arrived at its browser (`Connection.image_handed`).

These checks run in the thread of viser's server. Images and updates of the page are sent in the
same thread (`call_in_server_thread`), because viser's buffers are not thread-safe while browsers
connect or disconnect.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gzip
import hmac
import html
import http
import logging
import math
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, Any

import msgspec
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.frames import CTRL_OPCODES, Frame
from websockets.http11 import Request, Response
from websockets.typing import Data

from snowsplat.viewer.hosts import NO_TOKEN, KnownHosts

# Maximum values:
_WAITING = 96  # connections without a valid request; a new connection replaces the oldest one
_PAGES = 16  # connections that download the page
_BROWSERS = 16  # connected browsers
_REQUEST = 16 << 10  # bytes of an HTTP request
_MESSAGE = 64 << 10  # bytes of a message
_RATE = 100.0  # messages per second; a page sends 50 while its camera moves
_BURST = 1000.0  # messages at once; they accumulate while a training step blocks the process
_FRAMES = 16  # WebSocket frames of a message; browsers send short messages in one frame
_SHARE = 0.2  # share of a core that the server uses
_LONGEST_PAUSE = 1.0  # seconds for which the server is paused at a time

_PIECE = 4 << 10  # bytes that are processed before the limits are checked again
_TICK = 0.05  # seconds between two measurements of the server's processor time

_PROTOCOL = f"viser-v{viser.__version__}"
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # the URL contains the token
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'self'",
}
_log = logging.getLogger(__name__)
# websockets logs a traceback for every malformed request. This logger discards them.
_discard = logging.getLogger(f"{__name__}.connections")
_discard.setLevel(logging.CRITICAL + 1)

#: The connection that the present task serves.
current_connection: ContextVar[Connection] = ContextVar("current_connection")
_Answer = Callable[[ServerConnection, Request], Response | None]
_listen = websockets.asyncio.server.serve


class Guard:
    """The checks of one server."""

    def __init__(self, hosts: KnownHosts, token: str, title: str) -> None:
        """``token``: the first component of all paths. ``title``: that of the page."""
        self.serves = False  # whether viser has started its server through `serve`
        self.is_open = False  # whether the scene is complete, so that browsers may connect
        self._hosts, self._token = hosts, token.encode()
        self._title = f"<title>{html.escape(title)}</title>".encode()
        self._titled: dict[str, bytes] = {}  # the page, by its Content-Encoding
        self._waiting: dict[Connection, None] = {}  # oldest first
        self._pages: set[Connection] = set()
        self._browsers: set[Connection] = set()
        root = Path(viser.__file__).parent / "client" / "build"
        files = (path for path in root.rglob("*") if path.is_file())
        self._paths = {"/", *(f"/{path.relative_to(root).as_posix()}" for path in files)}

    def serve(self, handler: Any, host: str, port: int, **options: Any) -> Any:
        """Replaces `websockets.asyncio.server.serve`: adds the checks to its options."""
        self.serves = True
        answer = options["process_request"]
        options |= {
            "process_request": functools.partial(self._answer, answer),
            "create_connection": functools.partial(Connection, self),
            "max_size": _MESSAGE,
            "server_header": "snowsplat",
            "logger": _discard,
        }
        return _listen(handler, host, port, **options)

    def _answer(
        self, answer: _Answer, connection: ServerConnection, request: Request
    ) -> Response | None:
        """The response to a request: that of viser, or a rejection; None accepts a WebSocket."""
        assert isinstance(connection, Connection)
        response = self._refusal(connection, request) or answer(connection, request)
        if response is None:
            self._waiting.pop(connection, None)
            self._browsers.add(connection)
            current_connection.set(connection)  # the handler runs in the same task
            return None
        if response.status_code == http.HTTPStatus.OK:
            self._waiting.pop(connection, None)
            self._pages.add(connection)
            if request.path == "/":
                self._set_title(response)
        for name, value in _HEADERS.items():
            response.headers[name] = value
        return response

    def _set_title(self, response: Response) -> None:
        """Replace the title of viser's page, for which viser has no setting."""
        coding = response.headers["Content-Encoding"]
        if coding not in self._titled:
            zipped = coding == "gzip"
            page = gzip.decompress(response.body) if zipped else bytes(response.body)
            page = page.replace(b"<title>Viser</title>", self._title, 1)
            self._titled[coding] = gzip.compress(page) if zipped else page
        response.body = self._titled[coding]
        if "Content-Length" in response.headers:
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(response.body))

    def _refusal(self, connection: ServerConnection, request: Request) -> Response | None:
        """A response that rejects the request. None: it is accepted; the token is removed."""

        def refuse(status: http.HTTPStatus, *more: tuple[str, str], text: str = "") -> Response:
            body = text.encode()
            more += (("Content-Type", "text/plain; charset=utf-8"),) if text else ()
            length = ("Content-Length", str(len(body)))
            headers = Headers([*more, length, ("Connection", "close")])
            return Response(status, status.phrase, headers, body)

        if not self.is_open:
            return refuse(http.HTTPStatus.SERVICE_UNAVAILABLE, ("Retry-After", "1"))
        values = {name: request.headers.get_all(name) for name in ("Host", "Origin", "Upgrade")}
        if any(len(given) > 1 for given in values.values()) or not values["Host"]:
            return refuse(http.HTTPStatus.BAD_REQUEST)
        host = values["Host"][0]
        if not self._hosts.include(host):
            return refuse(http.HTTPStatus.MISDIRECTED_REQUEST, text=self._hosts.explain(host))
        if not all(self._hosts.include_page(origin, host) for origin in values["Origin"]):
            return refuse(http.HTTPStatus.FORBIDDEN)
        path = self._path(request.path)
        if path is None or path not in self._paths:
            return refuse(
                http.HTTPStatus.NOT_FOUND, text="" if request.path.strip("/") else NO_TOKEN
            )
        request.path = path
        if not values["Upgrade"]:
            if len(self._pages) >= _PAGES:
                return refuse(http.HTTPStatus.SERVICE_UNAVAILABLE, ("Retry-After", "1"))
            return None
        asked = request.headers.get_all("Sec-WebSocket-Protocol")
        if values["Upgrade"] != ["websocket"] or asked != [_PROTOCOL]:
            return refuse(http.HTTPStatus.BAD_REQUEST)
        if len(self._browsers) >= _BROWSERS:
            return refuse(http.HTTPStatus.SERVICE_UNAVAILABLE, ("Retry-After", "5"))
        return None

    def _path(self, path: str) -> str | None:
        """The path without the token; None if the token is wrong. %-encoding is not decoded."""
        path = path.partition("?")[0]
        given, _, rest = path.removeprefix("/").partition("/")
        return f"/{rest}" if hmac.compare_digest(_bytes(given), self._token) else None

    def connected(self, connection: Connection) -> None:
        """Called when a connection is made."""
        self._waiting[connection] = None
        if len(self._waiting) > _WAITING:
            oldest = next(iter(self._waiting))
            del self._waiting[oldest]
            oldest.transport.abort()

    def disconnected(self, connection: Connection) -> None:
        """Called when a connection is closed."""
        self._waiting.pop(connection, None)
        self._pages.discard(connection)
        self._browsers.discard(connection)


def _bytes(path: str) -> bytes:
    return path.encode("ascii", "surrogateescape")  # inverse of the decoding in websockets


class Connection(ServerConnection):
    """A connection that is closed if it exceeds the limits."""

    def __init__(self, guard: Guard, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._guard = guard
        self._refused = False
        self._head = 0  # bytes of the request received so far
        self._budget = _BURST  # number of frames that may be received now
        self._counted = self.loop.time()  # when the budget was updated
        self._frames = 0  # number of frames of the current message
        # Called when images have arrived at the browser, with their number.
        self.on_arrival: Callable[[int], None] = lambda images: None
        # Numbers of images: handed to viser, sent, and arrived.
        self._handed = self._sent = self._arrived = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._guard.connected(self)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._guard.disconnected(self)

    def data_received(self, data: bytes) -> None:
        for start in range(0, len(data), _PIECE):  # so that little is processed before a rejection
            if self._refused:
                return
            piece = data[start : start + _PIECE]
            if self.request is None:
                self._head += len(piece)
                if self._head > _REQUEST:
                    self._refuse()
                    return
            super().data_received(piece)

    def process_event(self, event: Any) -> None:
        if isinstance(event, Frame) and not self._is_within_limits(event):
            self._refuse()
        if not self._refused:
            super().process_event(event)

    def _is_within_limits(self, frame: Frame) -> bool:
        """Count this frame, and return whether a page could send it at this rate."""
        now = self.loop.time()
        self._budget = min(_BURST, self._budget + _RATE * (now - self._counted)) - 1.0
        self._counted = now
        if frame.opcode not in CTRL_OPCODES:
            self._frames = 0 if frame.fin else self._frames + 1
        return self._budget >= 0.0 and self._frames < _FRAMES

    def _refuse(self) -> None:
        self._refused = True
        self.transport.abort()

    def image_handed(self) -> None:
        """Record that viser will send one more image. If it gets several, it may send the last."""
        self._handed += 1

    async def send(self, message: Any, text: bool | None = None) -> None:
        handed = self._handed
        await super().send(message, text)
        if handed > self._sent:
            self._sent = handed
            # Browsers answer a ping as soon as they have received everything before it.
            pong = asyncio.ensure_future(await self.ping())
            pong.add_done_callback(functools.partial(self._answered, handed))

    def _answered(self, handed: int, pong: asyncio.Future[float]) -> None:
        if pong.cancelled() or pong.exception() is not None:  # the connection is closed
            return
        arrived, self._arrived = handed - self._arrived, handed
        self.on_arrival(arrived)

    async def recv(self, decode: bool | None = None) -> Data:  # type: ignore[override]
        while True:
            await self.drain()  # waits until the client has read its data
            data = await super().recv(decode)
            if is_valid_message(data):
                return data


# Messages of the page


_Number = float
_Name = Annotated[str, msgspec.Meta(max_length=200)]
_Size = Annotated[float, msgspec.Meta(ge=1, le=16384)]
_Vector = tuple[_Number, _Number, _Number]
_Scalar = bool | float | _Name
_Value = _Scalar | None | Annotated[list[_Scalar], msgspec.Meta(max_length=16)]


class _Camera(msgspec.Struct, tag="ViewerCameraMessage", forbid_unknown_fields=True):
    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Vector
    fov: _Number
    near: _Number
    far: _Number
    image_height: _Size
    image_width: _Size
    look_at: _Vector
    up_direction: _Vector

    def numbers(self) -> list[object]:
        return [*self.wxyz, *self.position, *self.look_at, *self.up_direction, self.fov]


class _Update(msgspec.Struct, tag="GuiUpdateMessage", forbid_unknown_fields=True):
    uuid: _Name
    # viser would set any attribute of a control that is named here.
    updates: Annotated[dict[_Name, _Value], msgspec.Meta(max_length=1)]

    def numbers(self) -> list[object]:
        return [each for v in self.updates.values() for each in (v if isinstance(v, list) else [v])]


class _Click(msgspec.Struct, tag="SceneNodeClickMessage", forbid_unknown_fields=True):
    name: _Name
    instance_index: int | None
    ray_origin: _Vector
    ray_direction: _Vector
    screen_pos: tuple[_Number, _Number]
    modifier: _Name | None
    owner: _Name = ""

    def numbers(self) -> list[object]:
        return [*self.ray_origin, *self.ray_direction, *self.screen_pos]


class _Command(msgspec.Struct, tag="CommandTriggerMessage", forbid_unknown_fields=True):
    uuid: _Name

    def numbers(self) -> list[object]:
        return []


_decoder = msgspec.msgpack.Decoder(_Camera | _Update | _Click | _Command)


def is_valid_message(data: Data) -> bool:
    """Whether ``data`` is a message that the page sends, and all its numbers are finite."""
    if not isinstance(data, bytes):
        return False
    try:
        message = _decoder.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return False
    if isinstance(message, _Update) and list(message.updates) != ["value"]:
        return False
    return all(math.isfinite(n) for n in message.numbers() if isinstance(n, float))


# The thread of the server


class ServerTimeLimit:
    """Limits the share of a core that the server's thread uses during training.

    It also logs errors of this thread.
    """

    def __init__(self, server: viser.ViserServer, training: Callable[[], bool]) -> None:
        self._loop = server.get_event_loop()
        self._training = training
        # At the last measurement, in seconds: processor time of the thread, and the clock.
        self._used = self._measured = 0.0
        self._uncounted = 0.0  # processor time since then that is not counted, in seconds
        call_in_server_thread(server, self._begin)

    def _begin(self) -> None:
        self._loop.set_exception_handler(_log_error)
        self._measure()

    def _measure(self) -> None:
        used = time.thread_time() - self._used - self._uncounted
        pause = used / _SHARE - (time.monotonic() - self._measured)
        if self._measured and pause > 0.0 and self._training():
            time.sleep(min(pause, _LONGEST_PAUSE))
        self._used, self._measured, self._uncounted = time.thread_time(), time.monotonic(), 0.0
        self._loop.call_later(_TICK, self._measure)

    @contextlib.contextmanager
    def uncounted(self) -> Iterator[None]:
        """A context for work that the training has started: its time is not limited."""
        before = time.thread_time()
        try:
            yield
        finally:
            self._uncounted += time.thread_time() - before


def call_in_server_thread(server: viser.ViserServer, run: Callable[[], None]) -> None:
    """Schedule a call of ``run`` in the server's thread; does nothing if the server has stopped."""
    with contextlib.suppress(RuntimeError):
        server.get_event_loop().call_soon_threadsafe(run)


def _log_error(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    _log.debug("%s", context.get("message"), exc_info=context.get("exception"))
