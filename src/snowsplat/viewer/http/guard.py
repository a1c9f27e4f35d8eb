"""Checks requests before an app answers them, and limits their number, size and duration.

Other users of this machine can connect to a server, and any web page can make a browser do so.
Therefore:

- The Host and Origin headers of a request must be those of this server (`KnownHosts`), and its
  path must begin with a secret token; or with one that only reads a part (`Guard.look`).
- Only requests that carry data (POST, PUT) have a body, of a declared size. h11 refuses what is
  not a request, and one that is too long.
- The numbers of connections and of WebSockets are limited. A connection that is silent, sends a
  request slowly, or does not receive what is sent to it, is closed.

`Guard` does what an ASGI app can do; the two protocols close the connections. Who has the token may
open a WebSocket; uvicorn limits the size of messages, and reads no more than the app receives.
"""

from __future__ import annotations

import asyncio
import base64
import functools
import hmac
import logging
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any, Protocol

import h11
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from snowsplat.viewer.hosts import NO_TOKEN, KnownHosts

# Seconds after which a connection is closed:
IDLE_SECONDS = 60.0  # without a complete head of a request, or without further data of a body
_SEND_SECONDS = 60.0  # if the client does not receive a block
# Maximum values:
HEAD_SIZE = 16 << 10  # bytes of the head of a request
_BODY_SIZE = 16 << 20  # bytes of the body of a request
# Open connections. A new connection replaces the oldest one that has not made a valid request; if
# there is none, the new connection is closed.
_CONNECTIONS = 256
_WEBSOCKETS = 16
MESSAGE_SIZE = 64 << 10  # bytes of a WebSocket message

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
        if (status := _problem_of_body(scope, headers)) is not None:
            return Response(status_code=status, headers={"Connection": "close"})
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


def _problem_of_body(scope: Scope, headers: Mapping[bytes, str]) -> HTTPStatus | None:
    """The status with which a request is refused because of its body."""
    length = int(headers.get(b"content-length", "0"))  # h11 has checked that it is a number
    has_body = scope["type"] == "http" and scope["method"] in ("POST", "PUT")
    # Without a declared size, a body has no limit.
    if b"transfer-encoding" in headers or (length and not has_body):
        return HTTPStatus.BAD_REQUEST
    return HTTPStatus.REQUEST_ENTITY_TOO_LARGE if length > _BODY_SIZE else None


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
    """A connection that is closed if it does not send a request in time."""

    def __init__(self, guard: Guard, *args: Any, **options: Any) -> None:
        """``args``, ``options``: those of uvicorn."""
        super().__init__(*args, **options)
        self._guard = guard
        self.app = functools.partial(guard.answer, self)
        self.ws_protocol_class = functools.partial(  # type: ignore[assignment]
            WebSocketConnection, guard
        )
        self.logger, self.access_log = _discard, False

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
        was_idle = self.conn.their_state is h11.IDLE
        super().data_received(data)
        if not (was_idle and self.conn.their_state is h11.IDLE):  # a slow head gets no more time
            self._set_deadline()

    def _should_upgrade(self) -> bool:
        # The parser of WebSockets would never answer other methods.
        return self.scope["method"] == "GET" and super()._should_upgrade()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        self._receiving.set(None)
        self._sending.set(None)
        super().handle_websocket_upgrade(event)

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._set_deadline()

    def _set_deadline(self) -> None:
        """While a complete request is answered, there is none for receiving."""
        is_read = self.conn.their_state not in (h11.IDLE, h11.SEND_BODY)
        is_other = self.transport.get_protocol() is not self
        closing = self.transport.is_closing()
        self._receiving.set(None if is_read or is_other or closing else IDLE_SECONDS)


class WebSocketConnection(_SendLimit, WebSocketsSansIOProtocol):
    """A WebSocket that is closed if its client does not receive what is sent to it."""

    def __init__(self, guard: Guard, *args: Any, **options: Any) -> None:
        """``args``, ``options``: those of uvicorn."""
        super().__init__(*args, **options)
        self._guard = guard
        self.app = functools.partial(guard.answer, self)
        self.logger = self.conn.logger = _discard

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._sending = _Deadline(self.transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self._sending.set(None)
        self._guard.disconnected(self.transport)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self.transport.is_closing():
            return
        super().data_received(data)
        # What its parser answers to a line that is too long, such as a cookie, is not sent.
        if self.conn.handshake_exc is not None and not self.handshake_initiated:
            self.transport.write(b"".join(self.conn.data_to_send()))
            self.transport.close()
