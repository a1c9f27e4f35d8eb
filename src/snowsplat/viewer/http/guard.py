"""Checks requests before an app answers them, and limits their number and size.

Other users of this machine can connect to a server, and any web page can make a browser do so.
Therefore:

- The Host and Origin headers of a request must be those of this server (`KnownHosts`), and its
  path must begin with a secret token; or with one that only reads a part (`Guard.look`).
- Only requests that carry data (POST, PUT) have a body, of a declared size. h11 refuses what is
  not a request, and one that is too long.
- The number of connections is limited (`Connection`). uvicorn limits the size of messages of
  WebSockets, and closes those that no longer answer.
"""

import asyncio
import base64
import hmac
import logging
from collections.abc import Mapping
from http import HTTPStatus

from starlette.requests import ClientDisconnect
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.utils import ClientDisconnected

from snowsplat.viewer.hosts import NO_TOKEN, KnownHosts

# Maximum values:
HEAD_SIZE = 16 << 10  # bytes of the head of a request
_BODY_SIZE = 16 << 20  # bytes of the body of a request
MESSAGE_SIZE = 64 << 10  # bytes of a WebSocket message
CONNECTIONS = 256  # open ones

_ALWAYS = {
    "Server": "snowsplat",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # the URL contains the token
    "Cross-Origin-Resource-Policy": "same-origin",
}
#: What a request has of its server: `Guard.look`; None if its own token only reads.
LOOK = "snowsplat.look"
_log = logging.getLogger(__name__)

_DISCONNECTED = (
    ConnectionError,
    TimeoutError,
    ClientDisconnect,
    ClientDisconnected,
    WebSocketDisconnect,
)


class Guard:
    """The checks of one server: an ASGI app before its ``app``, which sees paths without the
    token."""

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

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        started = False

        async def send_with_headers(message: Message) -> None:
            nonlocal started
            started = True
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                own = {name for name, _ in message["headers"]}
                more = [header for header in self._headers if header[0] not in own]
                message = {**message, "headers": [*message["headers"], *more]}
            await asyncio.sleep(0)  # it may just have disconnected, which the next line then tells
            await send(message)

        try:
            await (self._refusal(scope) or self._app)(scope, receive, send_with_headers)
        except Exception as error:
            # A browser that disconnects during a transfer is not an error.
            if not isinstance(error, _DISCONNECTED):
                _log.error("web server: %s: %s", type(error).__name__, error, exc_info=True)
            if started:  # the connection is closed
                raise
            await Response(status_code=500)(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> Response | None:
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


class Connection(H11Protocol):
    """A connection; it is closed at once if there are `CONNECTIONS` already."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > CONNECTIONS:
            transport.abort()

    def _should_upgrade(self) -> bool:
        # The parser of WebSockets would never answer other methods.
        return self.scope["method"] == "GET" and super()._should_upgrade()
