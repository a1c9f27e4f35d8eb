"""Checks requests before an app answers them, and limits their number, size and duration.

Other users of this machine can connect to a server, and any web page can make a browser do so.
Therefore:

- The Host and Origin headers of a request must be those of this server (`KnownHosts`), and its
  path must begin with a secret token; or with one that only reads a part (`Guard.look`).
- The head of a request must be exactly as the protocol defines it. Only requests that carry data
  (POST, PUT) have a body, of a declared size.
- The numbers of connections and of WebSockets are limited. A connection that is silent, sends a
  request slowly, or does not receive what is sent to it, is closed.
- WebSocket messages are short, and a client that sends more of them than a page can send is
  disconnected. No more of them are read than the app receives.

`Guard` does what an ASGI app can do; the two protocols do the rest.
"""

from __future__ import annotations

import asyncio
import base64
import functools
import hmac
import logging
import re
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any, Protocol, cast

import h11
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CTRL_OPCODES, Frame

from snowsplat.viewer.hosts import NO_TOKEN, KnownHosts

# Seconds after which a connection is closed:
IDLE_SECONDS = 60.0  # without a request, or without further data of a body
_REQUEST_SECONDS = 10.0  # with an incomplete head
_SEND_SECONDS = 60.0  # if the client does not receive a block
# Maximum values:
_HEAD_SIZE = 16 << 10  # bytes of the head of a request
_HEAD_LINES = 100
_BODY_SIZE = 16 << 20  # bytes of the body of a request
# Open connections. A new connection replaces the oldest one that has not made a valid request; if
# there is none, the new connection is closed.
_CONNECTIONS = 256
_WEBSOCKETS = 16
MESSAGE_SIZE = 64 << 10  # bytes of a WebSocket message
_RATE = 100.0  # WebSocket frames per second; a page sends 50 while its camera moves
_BURST = 1000.0  # frames at once; they accumulate while a training step blocks the process
_FRAMES = 16  # frames of a message; browsers send short messages in one frame
_PIECE = 4 << 10  # bytes of frames that are processed before the limits are checked again

# The request line and headers, exactly as the protocol defines them. Requests with unusual line
# ends or characters are rejected, because another HTTP parser, such as that of a proxy, could find
# their end at another position.
_HEAD = re.compile(
    rb"[!-~]+ [!-~]+ HTTP/1\.[01](\r\n[!#$%&'*+.^_`|~0-9A-Za-z-]+:[\t -~\x80-\xff]*)*\r\n\r\n"
)
_ALWAYS = {
    "Server": "snowsplat",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # the URL contains the token
    "Cross-Origin-Resource-Policy": "same-origin",
}
#: What a request has of its server: `Guard.look`; None if its own token only reads.
LOOK = "snowsplat.look"
_log = logging.getLogger(__name__)
# uvicorn and websockets log each malformed request. This logger discards the messages.
_discard = logging.getLogger(f"{__name__}.connections")
_discard.setLevel(logging.CRITICAL + 1)


_DISCONNECTED = (ConnectionError, TimeoutError, ClientDisconnected, WebSocketDisconnect)


class _Connection(Protocol):
    transport: asyncio.Transport


class Guard:
    """The checks of one server, before its ``app``, which sees paths without the token."""

    def __init__(
        self, app: ASGIApp, hosts: KnownHosts, token: str, headers: Mapping[str, str]
    ) -> None:
        """``token``: the first component of all paths. ``headers``: further ones of responses."""
        self.hosts, self.token = hosts, token
        self._app = app
        self._headers = [
            (name.lower().encode(), value.encode("latin-1"))
            for name, value in {**_ALWAYS, **headers}.items()
        ]
        self._unverified: dict[asyncio.Transport, None] = {}  # no valid request yet; oldest first
        self._verified: set[asyncio.Transport] = set()  # have made a valid request
        self._websockets: set[asyncio.Transport] = set()

    async def answer(
        self, connection: _Connection, scope: Scope, receive: Receive, send: Send
    ) -> None:
        """The ASGI app for the requests of one connection."""
        started = False

        async def send_with_headers(message: Message) -> None:
            nonlocal started
            started = True
            if transport.is_closing():
                raise ConnectionResetError("the browser has disconnected")
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                own = {name for name, _ in message["headers"]}
                more = [header for header in self._headers if header[0] not in own]
                message = {**message, "headers": [*message["headers"], *more]}
            await send(message)

        transport = connection.transport
        response = self._refusal(transport, scope)
        try:
            await (response or self._app)(scope, receive, send_with_headers)
        except Exception as error:
            # A browser that disconnects during a download is not an error.
            if not isinstance(error, _DISCONNECTED):
                _log.error("web server: %s: %s", type(error).__name__, error, exc_info=True)
            if started:
                transport.abort()
            else:
                await Response(status_code=500)(scope, receive, send_with_headers)

    def _refusal(self, transport: asyncio.Transport, scope: Scope) -> Response | None:
        """A response that rejects the request. None: it is accepted; the token is removed."""
        headers = {name: value.decode("latin-1") for name, value in scope["headers"]}
        host, origin = headers.get(b"host", ""), headers.get(b"origin")
        if not self.hosts.include(host):
            return _text(HTTPStatus.MISDIRECTED_REQUEST, self.hosts.explain(host))
        if origin is not None and not self.hosts.include_page(origin, host):
            return Response(status_code=HTTPStatus.FORBIDDEN)
        path: bytes = scope["raw_path"]
        given, slash, rest = path.removeprefix(b"/").partition(b"/")
        is_full = hmac.compare_digest(given, self.token.encode())
        if not path.startswith(b"/") or not (is_full or self._may_look(given, scope)):
            return _text(HTTPStatus.NOT_FOUND, NO_TOKEN)
        if not slash:  # relative addresses of the page need it
            return Response(
                status_code=HTTPStatus.PERMANENT_REDIRECT,
                headers={"Location": f"{given.decode()}/"},
            )
        if transport in self._unverified:
            del self._unverified[transport]
            self._verified.add(transport)
        if scope["type"] == "websocket":
            if len(self._websockets) >= _WEBSOCKETS:
                return Response(
                    status_code=HTTPStatus.SERVICE_UNAVAILABLE, headers={"Retry-After": "5"}
                )
            self._websockets.add(transport)
        scope["raw_path"] = b"/" + rest
        scope["path"] = "/" + scope["path"].removeprefix("/").partition("/")[2]
        scope[LOOK] = self.look if is_full else None
        return None

    def look(self, path: str) -> str:
        """A token that only reads what begins with the first three names of ``path``: "a/b/c/"."""
        begin = "/".join(path.split("/")[:3]).encode("utf-8", "replace")
        digest = hmac.digest(self.token.encode(), begin, "sha256")[:16]
        return base64.urlsafe_b64encode(digest).decode().rstrip("=")

    def _may_look(self, given: bytes, scope: Scope) -> bool:
        path = scope["path"].removeprefix("/").partition("/")[2]
        allowed = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        return allowed and hmac.compare_digest(given, self.look(path).encode())

    def connected(self, transport: asyncio.Transport) -> None:
        """Called when a connection is made."""
        if len(self._unverified) + len(self._verified) >= _CONNECTIONS:
            if not self._unverified:
                transport.abort()
                return
            oldest = next(iter(self._unverified))
            del self._unverified[oldest]
            oldest.abort()
        self._unverified[transport] = None
        # A protocol is then told that writing pauses as soon as data is not received at once.
        transport.set_write_buffer_limits(high=0)

    def disconnected(self, transport: asyncio.Transport) -> None:
        """Called when a connection is closed."""
        self._unverified.pop(transport, None)
        self._verified.discard(transport)
        self._websockets.discard(transport)

    def close(self) -> None:
        """Close all connections."""
        for transport in (*self._unverified, *self._verified):
            transport.abort()


def _text(status: HTTPStatus, text: str) -> Response:
    return Response(text, status, media_type="text/plain" if text else None)


class _Deadline:
    """Closes a connection at a later time, unless it is set again."""

    def __init__(self, transport: asyncio.Transport) -> None:
        self._transport = transport
        self._timer: asyncio.TimerHandle | None = None

    def set(self, seconds: float | None) -> None:
        """Set the deadline; None removes it."""
        if self._timer is not None:
            self._timer.cancel()
        loop = asyncio.get_running_loop()
        self._timer = None if seconds is None else loop.call_later(seconds, self._transport.abort)


class _SendLimit(asyncio.Protocol):
    """Closes a connection whose client does not receive what is sent to it."""

    _sending: _Deadline

    def pause_writing(self) -> None:
        super().pause_writing()
        self._sending.set(_SEND_SECONDS)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._sending.set(None)


class HttpConnection(_SendLimit, H11Protocol):
    """A connection that hands on a request when its head is complete and valid."""

    def __init__(self, guard: Guard, *args: Any, **options: Any) -> None:
        """``args``, ``options``: those of uvicorn."""
        super().__init__(*args, **options)
        self._guard = guard
        self.app = functools.partial(guard.answer, self)
        self.ws_protocol_class = functools.partial(  # type: ignore[assignment]
            WebSocketConnection, guard
        )
        self.logger, self.access_log = _discard, False
        self._received = b""  # data that follows the current request
        self._body = 0  # bytes of the body of the current request that are not received yet

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._receiving, self._sending = _Deadline(transport), _Deadline(transport)
        self._receiving.set(IDLE_SECONDS)
        self._guard.connected(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self._receiving.set(None)
        self._sending.set(None)
        self._guard.disconnected(self.transport)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        is_first = not self._received
        self._received += data
        self._advance(is_first)

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        self._receiving.set(None)
        self._sending.set(None)
        super().handle_websocket_upgrade(event)
        rest, self._received = self._received, b""
        if rest:
            cast(asyncio.Protocol, self.transport.get_protocol()).data_received(rest)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if not self.transport.is_closing():
            self._receiving.set(IDLE_SECONDS)
            self._advance(True)

    def _advance(self, is_first: bool) -> None:
        """Hand on what was received; ``is_first``: nothing of it was seen before."""
        while self._received and not self.transport.is_closing():
            if self._body:
                end = min(self._body, len(self._received))
                self._body -= end
            elif not self._is_idle():
                self.flow.pause_reading()  # until the current request is answered
                return
            else:
                end = self._received.find(b"\r\n\r\n") + 4
                is_whole = end >= 4
                if not is_whole and len(self._received) <= _HEAD_SIZE:
                    if is_first:
                        self._receiving.set(_REQUEST_SECONDS)
                    return
                status = self._check(self._received[:end] if is_whole else self._received)
                if status is not None:
                    self._refuse(status)
                    return
            piece, self._received = self._received[:end], self._received[end:]
            is_first = True
            super().data_received(piece)
            if self.transport.get_protocol() is self:
                self._receiving.set(IDLE_SECONDS if self._body or self._is_idle() else None)

    def _is_idle(self) -> bool:
        """Whether the last request is answered."""
        return bool(self.conn.states == {h11.CLIENT: h11.IDLE, h11.SERVER: h11.IDLE})

    def _check(self, head: bytes) -> HTTPStatus | None:
        """The status with which a request is rejected; None accepts it, and sets ``_body``."""
        if len(head) > _HEAD_SIZE or head.count(b"\n") > _HEAD_LINES:
            return HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE
        if not _HEAD.fullmatch(head):
            return HTTPStatus.BAD_REQUEST
        line, *lines = head[:-4].split(b"\r\n")
        values: dict[bytes, list[bytes]] = {}
        for name, _, value in (each.partition(b":") for each in lines):
            values.setdefault(name.lower(), []).append(value.strip())
        if any(len(values.get(name, [])) > 1 for name in (b"host", b"origin", b"content-length")):
            return HTTPStatus.BAD_REQUEST
        method = line.split(b" ")[0]
        # uvicorn would log requests for other protocols, and never answer those by other methods.
        if b"upgrade" in values and (method, values[b"upgrade"]) != (b"GET", [b"websocket"]):
            return HTTPStatus.BAD_REQUEST
        length = values.get(b"content-length", [b"0"])[0]
        # Without a declared size, a body has no limit.
        if b"transfer-encoding" in values or not re.fullmatch(rb"\d{1,18}", length):
            return HTTPStatus.BAD_REQUEST
        if int(length) and method not in (b"POST", b"PUT"):
            return HTTPStatus.BAD_REQUEST
        if int(length) > _BODY_SIZE:
            return HTTPStatus.REQUEST_ENTITY_TOO_LARGE
        self._body = int(length)
        return None

    def _refuse(self, status: HTTPStatus) -> None:
        """Answer what is not a request, and close the connection."""
        head = f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Length: 0\r\n"
        self._received = b""
        self.transport.write(f"{head}Connection: close\r\n\r\n".encode())
        self._sending.set(_SEND_SECONDS)
        self.transport.close()


class WebSocketConnection(_SendLimit, WebSocketsSansIOProtocol):
    """A WebSocket that is closed if it exceeds the limits."""

    def __init__(self, guard: Guard, *args: Any, **options: Any) -> None:
        """``args``, ``options``: those of uvicorn."""
        super().__init__(*args, **options)
        self._guard = guard
        self.app = functools.partial(guard.answer, self)
        self.logger = self.conn.logger = _discard
        self._events = self.conn.events_received
        self.conn.events_received = self._counted  # type: ignore[method-assign]
        self._budget = _BURST  # number of frames that may be received now
        self._updated = self.loop.time()  # when the budget was updated
        self._frames = 0  # number of frames of the current message

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._sending = _Deadline(self.transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self._sending.set(None)
        self._guard.disconnected(self.transport)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        for start in range(0, len(data), _PIECE):  # so that little is processed before a rejection
            if self.transport.is_closing():
                return
            super().data_received(data[start : start + _PIECE])
            # What its parser answers to a line that is too long, such as a cookie, is not sent.
            if self.conn.handshake_exc is not None and not self.handshake_initiated:
                self.transport.write(b"".join(self.conn.data_to_send()))
                self.transport.close()

    def _counted(self) -> list[Any]:
        """The new events; none if a page could not send them at this rate."""
        events = self._events()
        frames = [event for event in events if isinstance(event, Frame)]
        now = self.loop.time()
        self._budget = min(_BURST, self._budget + _RATE * (now - self._updated)) - len(frames)
        self._updated = now
        for frame in frames:
            if frame.opcode not in CTRL_OPCODES:
                self._frames = 0 if frame.fin else self._frames + 1
            if self._frames >= _FRAMES:
                self._budget = -1.0
        if self._budget < 0.0:
            self.transport.abort()
            return []
        return events
