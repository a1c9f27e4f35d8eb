"""The door of the network viewer: who comes in, what visitors may say, and how much work they make.

viser serves whoever reaches its port, believes what it is told, and does as much as it is asked,
in the process that trains. So what it starts its server with is `Guard.serve`:

- A request is answered where its Host is ours, its Origin is our page, and, where others than this
  machine can ask, its path begins with a word that cannot be guessed.
- So many connections are open, pages under way, browsers connected, and no more.
- A message is passed on if it is one of the three that our page sends and every number in it is
  one. Who says more than a page can is sent away; who does not read is not listened to.
- All of it may take a fifth of a core while this process trains.

And it all happens in viser's thread, what comes from the training too (`tell`): its buffers may
break when another thread adds to them while a browser comes or goes.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hmac
import http
import logging
import math
import time
from collections.abc import Callable, Iterator
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

from snowsplat.viewer.hosts import is_loopback, is_own_host, is_own_page

# Connections that have not been let in yet, of pages under way, and of browsers: at most. A new
# one of the first kind takes the place of the oldest.
_WAITING, _PAGES, _BROWSERS = 96, 16, 16
# Bytes of a request, of a message, and of what is looked at before it is asked whether to go on.
_REQUEST, _MESSAGE, _PIECE = 16 << 10, 64 << 10, 4 << 10
# Messages a second, and how many at once. A page sends 50 while a camera moves; what it sent while
# the training held this process up comes at once.
_RATE, _BURST = 100.0, 1000.0
# Frames that a message may come in: a browser sends what is so short in one.
_FRAMES = 16
# The part of a core that the server may take, seconds between two looks, and of rest at most.
_SHARE, _TICK, _LONGEST_REST = 0.2, 0.05, 1.0

_PROTOCOL = f"viser-v{viser.__version__}"
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # the address may be a secret
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'self'",
}
_log = logging.getLogger(__name__)
# What strangers send is no news: websockets writes a traceback for each.
_unheard = logging.getLogger(f"{__name__}.connections")
_unheard.setLevel(logging.CRITICAL + 1)

_Answer = Callable[[ServerConnection, Request], Response | None]
_listen = websockets.asyncio.server.serve


class Guard:
    """What stands before one server."""

    def __init__(self, host: str, token: str | None) -> None:
        """
        Args:
            host: where the server listens.
            token: what paths must begin with; None: nothing.
        """
        if token is None and not is_loopback(host):
            raise ValueError(f"{host}: a server that others reach needs a token")
        self.serves = False  # viser has started its server with this
        self.is_open = False  # what browsers are to find is in its place
        self._host, self._token = host, token
        self._waiting: dict[_Connection, None] = {}  # in the order in which they came
        self._pages: set[_Connection] = set()
        self._browsers: set[_Connection] = set()
        root = Path(viser.__file__).parent / "client" / "build"
        files = (path for path in root.rglob("*") if path.is_file())
        self._paths = {"/", *(f"/{path.relative_to(root).as_posix()}" for path in files)}

    def serve(self, handler: Any, host: str, port: int, **options: Any) -> Any:
        """In place of `websockets.asyncio.server.serve`."""
        self.serves = True
        answer = options["process_request"]
        options |= {
            "process_request": functools.partial(self._answer, answer),
            "create_connection": functools.partial(_Connection, self),
            "max_size": _MESSAGE,
            "server_header": "snowsplat",
            "logger": _unheard,
        }
        return _listen(handler, host, port, **options)

    def _answer(
        self, answer: _Answer, connection: ServerConnection, request: Request
    ) -> Response | None:
        """What viser says to a request; None: a browser is let in."""
        assert isinstance(connection, _Connection)
        response = self._refusal(connection, request) or answer(connection, request)
        if response is None:
            self._waiting.pop(connection, None)
            self._browsers.add(connection)
            return None
        if response.status_code == http.HTTPStatus.OK:
            self._waiting.pop(connection, None)
            self._pages.add(connection)
        for name, value in _HEADERS.items():
            response.headers[name] = value
        return response

    def _refusal(self, connection: ServerConnection, request: Request) -> Response | None:
        """Why a request is not passed on; None: it is, its path without the token."""

        def refuse(status: http.HTTPStatus, *more: tuple[str, str]) -> Response:
            headers = Headers([*more, ("Content-Length", "0"), ("Connection", "close")])
            return Response(status, status.phrase, headers)

        if not self.is_open:
            return refuse(http.HTTPStatus.SERVICE_UNAVAILABLE, ("Retry-After", "1"))
        values = {name: request.headers.get_all(name) for name in ("Host", "Origin", "Upgrade")}
        if any(len(given) > 1 for given in values.values()) or not values["Host"]:
            return refuse(http.HTTPStatus.BAD_REQUEST)
        host = values["Host"][0]
        if not is_own_host(host, self._host):
            return refuse(http.HTTPStatus.MISDIRECTED_REQUEST)
        if not all(is_own_page(origin, host) for origin in values["Origin"]):
            return refuse(http.HTTPStatus.FORBIDDEN)
        path = self._path(request.path)
        if path is None or path not in self._paths:
            return refuse(http.HTTPStatus.NOT_FOUND)
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
        """The path without the token, taken as it stands; None: without the right one."""
        path = path.partition("?")[0]
        if self._token is None:
            return path
        given, _, rest = path.removeprefix("/").partition("/")
        ours = self._token.encode()
        return f"/{rest}" if hmac.compare_digest(_bytes(given), ours) else None

    def came(self, connection: _Connection) -> None:
        """A connection was made."""
        self._waiting[connection] = None
        if len(self._waiting) > _WAITING:
            oldest = next(iter(self._waiting))
            del self._waiting[oldest]
            oldest.transport.abort()

    def went(self, connection: _Connection) -> None:
        """It is over."""
        self._waiting.pop(connection, None)
        self._pages.discard(connection)
        self._browsers.discard(connection)


def _bytes(path: str) -> bytes:
    return path.encode("ascii", "surrogateescape")  # as websockets decoded it


class _Connection(ServerConnection):
    """A connection that is let go on as long as it behaves like a browser."""

    def __init__(self, guard: Guard, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._guard = guard
        self._refused = False
        self._head = 0  # bytes of the request so far
        self._budget, self._counted = _BURST, self.loop.time()  # of frames, and when
        self._frames = 0  # of the message that is coming

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._guard.came(self)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._guard.went(self)

    def data_received(self, data: bytes) -> None:
        for start in range(0, len(data), _PIECE):  # so that little is done for one to be refused
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
        if isinstance(event, Frame) and not self._may(event):
            self._refuse()
        if not self._refused:
            super().process_event(event)

    def _may(self, frame: Frame) -> bool:
        """Whether it has said no more than a page does."""
        now = self.loop.time()
        self._budget = min(_BURST, self._budget + _RATE * (now - self._counted)) - 1.0
        self._counted = now
        if frame.opcode not in CTRL_OPCODES:
            self._frames = 0 if frame.fin else self._frames + 1
        return self._budget >= 0.0 and self._frames < _FRAMES

    def _refuse(self) -> None:
        self._refused = True
        self.transport.abort()

    async def recv(self, decode: bool | None = None) -> Data:  # type: ignore[override]
        while True:
            await self.drain()  # one that does not read what it asked for may not ask for more
            data = await super().recv(decode)
            if is_sane(data):
                return data


# What a page says


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
    # viser would set whatever attribute of a control is named here.
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


_decoder = msgspec.msgpack.Decoder(_Camera | _Update | _Click)


def is_sane(data: Data) -> bool:
    """Whether it is a message that our page sends, of numbers that are finite."""
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


class Governor:
    """Holds the thread of a server to its share of a core while there is a training to share with.

    Its errors go to our own log.
    """

    def __init__(self, server: viser.ViserServer, training: Callable[[], bool]) -> None:
        self._loop = server.get_event_loop()
        self._training = training
        self._used = self._seen = 0.0  # seconds of this thread and of the clock, when it looked
        self._granted = 0.0
        tell(server, self._begin)

    def _begin(self) -> None:
        self._loop.set_exception_handler(_note)
        self._look()

    def _look(self) -> None:
        used = time.thread_time() - self._used - self._granted
        rest = used / _SHARE - (time.monotonic() - self._seen)
        if self._seen and rest > 0.0 and self._training():
            time.sleep(min(rest, _LONGEST_REST))
        self._used, self._seen, self._granted = time.thread_time(), time.monotonic(), 0.0
        self._loop.call_later(_TICK, self._look)

    @contextlib.contextmanager
    def granted(self) -> Iterator[None]:
        """What happens within, the training itself has asked for: it does not count."""
        before = time.thread_time()
        try:
            yield
        finally:
            self._granted += time.thread_time() - before


def tell(server: viser.ViserServer, run: Callable[[], None]) -> None:
    """Run it in the thread of the server, soon; after its end, not at all."""
    with contextlib.suppress(RuntimeError):
        server.get_event_loop().call_soon_threadsafe(run)


def _note(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    _log.debug("%s", context.get("message"), exc_info=context.get("exception"))
