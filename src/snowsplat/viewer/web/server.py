"""A small web server for one page: a few files in memory or on disk, for one user.

It serves only the files that are passed to it: a requested name is looked up in a table, and is
never used as a path. The URL contains a secret token. Requests with an unknown Host header are
rejected, so a page of another site cannot reach the server through the domain name of that site
(DNS rebinding).
"""

from __future__ import annotations

import contextlib
import errno
import hmac
import io
import logging
import re
import secrets
import socket
import socketserver
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import Any, cast

from snowsplat.util.errors import SettingError
from snowsplat.viewer.hosts import ANY_HOST, NO_TOKEN, KnownHosts
from snowsplat.viewer.web.served_file import Served

# Seconds after which a connection is closed:
_IDLE_SECONDS = 60.0  # without a request
_REQUEST_SECONDS = 10.0  # with an incomplete request
_SEND_SECONDS = 60.0  # if the client does not receive a block
_REQUEST = 16 << 10  # maximum size of a request, bytes
# Maximum number of open connections. A new connection replaces the oldest one that has not made a
# valid request; if there is none, the new connection is closed.
_CONNECTIONS = 256
# The request line and headers, exactly as the protocol defines them. Requests with unusual line
# ends or characters are rejected, because another HTTP parser, such as that of a proxy, could find
# their end at another position.
_HEAD = re.compile(
    rb"[!-~]+ [!-~]+ HTTP/1\.[01](\r\n[!#$%&'*+.^_`|~0-9A-Za-z-]+:[\t -~\x80-\xff]*)*\r\n\r\n"
)
_RANGE = re.compile(r"bytes=(\d*)-(\d*)")

_log = logging.getLogger(__name__)


class StaticServer:
    """Serves ``files`` by name ("" is the page itself) from its creation until `close`.

    Every response has the additional ``headers``. ``allow_host``: names of proxies; see
    `KnownHosts`.
    Raises: UserError: the port is in use or not permitted, or the host is not an address of this
    machine; or an allowed name is none.
    """

    def __init__(
        self,
        files: Mapping[str, Served],
        headers: Mapping[str, str],
        host: str = "127.0.0.1",
        port: int = 0,
        allow_host: Sequence[str] = (),
    ) -> None:
        hosts = KnownHosts(host, allow_host)
        self.host = host
        self._token = secrets.token_urlsafe(16)
        self._server = _listen(host, port)
        self._server.prefix = f"/{self._token}/"
        self._server.files = dict(files)
        self._server.headers = dict(headers)
        self._server.hosts = hosts
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        return int(self._server.server_address[1])

    @property
    def url(self) -> str:
        """The URL of the page, for a browser on this machine."""
        return self.url_at("127.0.0.1" if self.host in ANY_HOST else self.host)

    @property
    def others(self) -> list[str]:
        """The URLs of the page for browsers on other machines, if they differ from `url`."""
        named = [self.url_at(socket.gethostname())] if self.host in ANY_HOST else []
        allowed = self._server.hosts.allowed
        return named + [f"https://{name}/{self._token}/" for name in allowed]

    def url_at(self, host: str) -> str:
        """The URL of the page if this machine is called ``host``."""
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/{self._token}/"

    def close(self) -> None:
        """Stop the server; running downloads are aborted."""
        self._server.shutdown()
        self._server.server_close()
        self._server.close_connections()

    def __enter__(self) -> StaticServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Server(socketserver.ThreadingTCPServer):
    daemon_threads = True
    block_on_close = False
    # On Windows, this would allow two servers to listen on the same port.
    allow_reuse_address = sys.platform != "win32"
    request_queue_size = 64

    prefix: str
    files: dict[str, Served]
    headers: dict[str, str]
    hosts: KnownHosts

    def __init__(self, *args: Any) -> None:
        self._lock = threading.Lock()
        self._unverified: dict[socket.socket, None] = {}  # no valid request yet; oldest first
        self._verified: set[socket.socket] = set()  # have made a valid request
        super().__init__(*args)

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether a new connection is accepted."""
        with self._lock:
            if len(self._unverified) + len(self._verified) >= _CONNECTIONS:
                if not self._unverified:
                    return False
                oldest = next(iter(self._unverified))
                del self._unverified[oldest]
                _shut_down(oldest)  # its next read fails, which ends its thread
            self._unverified[request] = None
            return True

    def mark_verified(self, request: socket.socket) -> None:
        """Record that a connection has made a valid request."""
        with self._lock:
            if request in self._unverified:
                del self._unverified[request]
                self._verified.add(request)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._unverified.pop(request, None)
            self._verified.discard(request)
        super().shutdown_request(request)

    def close_connections(self) -> None:
        """Close all connections."""
        with self._lock:
            for request in (*self._unverified, *self._verified):
                _shut_down(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        # A browser that disconnects during a download is not an error.
        error = sys.exc_info()[1]
        if not isinstance(error, ConnectionError | TimeoutError):
            _log.error("web server of the viewer: %s: %s", type(error).__name__, error)


def _shut_down(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class _Server6(_Server):
    address_family = socket.AF_INET6


def _listen(host: str, port: int) -> _Server:
    try:
        return (_Server6 if ":" in host else _Server)((host, port), _Handler)
    except OverflowError:
        raise SettingError("port", f"{port} is out of range; use 0 to 65535") from None
    except PermissionError:
        raise SettingError("port", f"no permission to use {port}; choose one above 1023") from None
    except socket.gaierror:
        raise SettingError(
            "host", f"{host} is not a name or address of this machine; use e.g. 127.0.0.1"
        ) from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise SettingError(
                "port", f"{port} is in use; choose another, or omit it: then a free one is used"
            ) from None
        raise SettingError(
            "host", f"cannot listen at {host} ({error.strerror}); use e.g. 127.0.0.1"
        ) from None


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version = "snowsplat"
    sys_version = ""
    timeout = _SEND_SECONDS

    def setup(self) -> None:
        super().setup()
        self._received = b""

    def handle_one_request(self) -> None:
        """Like the base class, but limits the size of a request and the time to receive it."""
        head = self._receive()
        self.close_connection = True
        if not head:
            return
        status = HTTPStatus.BAD_REQUEST
        if len(head) > _REQUEST:
            status = HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE
        elif _HEAD.fullmatch(head):
            self.rfile = io.BufferedReader(io.BytesIO(head))
            self.raw_requestline = self.rfile.readline()
            if not self.parse_request():
                return
            getattr(self, f"do_{self.command}", self._refuse_method)()
            return
        self.requestline, self.request_version, self.command = "", self.protocol_version, ""
        self._send_empty(status, {"Connection": "close"})

    def _receive(self) -> bytes | None:
        """The next request up to its empty line; None if there is no request.

        If a request is too long, the received part of it is returned.
        """
        started: float | None = time.monotonic() if self._received else None
        while (end := self._received.find(b"\r\n\r\n")) < 0:
            if len(self._received) > _REQUEST:
                return self._received
            left = _IDLE_SECONDS
            if started is not None:
                left = started + _REQUEST_SECONDS - time.monotonic()
            if left <= 0.0:
                return None
            try:
                self.connection.settimeout(left)
                more = self.connection.recv(_REQUEST)
            except OSError:
                return None
            finally:
                self.connection.settimeout(self.timeout)
            if not more:
                return None
            started = started or time.monotonic()
            self._received += more
        head, self._received = self._received[: end + 4], self._received[end + 4 :]
        return head

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def _refuse_method(self) -> None:
        self.close_connection = True  # the body of the request was not read
        self._send_empty(HTTPStatus.METHOD_NOT_ALLOWED, {"Allow": "GET, HEAD"})

    @property
    def _web_server(self) -> _Server:
        return cast(_Server, self.server)

    def _answer(self, with_body: bool) -> None:
        refusal = self._refusal()
        if refusal is not None:
            text = ""
            if refusal is HTTPStatus.MISDIRECTED_REQUEST:
                text = self._web_server.hosts.explain(self.headers.get("Host", ""))
            self._send_text(refusal, text, with_body)
            return
        file = self._file()
        if file is None:
            self._send_text(
                HTTPStatus.NOT_FOUND, "" if self.path.strip("/") else NO_TOKEN, with_body
            )
            return
        self._web_server.mark_verified(self.connection)
        common = {"ETag": file.etag, "Cache-Control": "private, no-cache", "Accept-Ranges": "bytes"}
        if file.etag in (self.headers.get("If-None-Match") or ""):
            self._send_empty(HTTPStatus.NOT_MODIFIED, common)
            return
        size = file.size
        part = self._range(file)
        if part is None:
            status, start, end = HTTPStatus.OK, 0, size
        elif part[0] < part[1]:
            status, (start, end) = HTTPStatus.PARTIAL_CONTENT, part
            common["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
        else:
            refused = {**common, "Content-Range": f"bytes */{size}"}
            self._send_empty(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, refused)
            return
        common |= {"Content-Type": file.type, "Content-Length": str(end - start)}
        self._send_head(status, common)
        if with_body:
            for block in file.blocks(start, end):
                self.wfile.write(block)

    def _refusal(self) -> HTTPStatus | None:
        """The status with which a request is rejected; None accepts it."""
        hosts, origins = (self.headers.get_all(name, []) for name in ("Host", "Origin"))
        # Only requests without a body are accepted: this server would read the body as a second
        # request. The same is true of data that another HTTP parser considers to be a body.
        bodies = (
            self.headers.get_all("Content-Length", []),
            self.headers.get_all("Transfer-Encoding", []),
        )
        if len(hosts) > 1 or len(origins) > 1 or bodies not in (([], []), (["0"], [])):
            self.close_connection = True
            return HTTPStatus.BAD_REQUEST
        host = hosts[0] if hosts else ""
        if not self._web_server.hosts.include(host):
            return HTTPStatus.MISDIRECTED_REQUEST
        if not all(self._web_server.hosts.include_page(origin, host) for origin in origins):
            return HTTPStatus.FORBIDDEN
        return None

    def _file(self) -> Served | None:
        """The file at the requested path. The path is not decoded, because all names are ASCII."""
        path = self.path.partition("?")[0]
        prefix = self._web_server.prefix
        start, name = path[: len(prefix)], path[len(prefix) :]
        if not hmac.compare_digest(start.encode(), prefix.encode()):
            return None
        return self._web_server.files.get(name)

    def _range(self, file: Served) -> tuple[int, int] | None:
        """The first requested byte, and the byte after the last; None: the complete file.

        A range outside of the file is empty. For multiple or malformed ranges, the complete file is
        sent, as the protocol allows.
        """
        match = _RANGE.fullmatch(self.headers.get("Range", "").replace(" ", ""))
        if match is None or match[0] == "bytes=-":
            return None
        if self.headers.get("If-Range", file.etag) != file.etag:
            return None
        size = file.size
        # int() rejects numbers with thousands of digits; 19 digits are past the end anyway.
        first, last = (int(digits[:19]) if digits else None for digits in match.groups())
        if first is None:
            return max(0, size - (last or 0)), size
        if last is None:
            return min(first, size), size
        if last < first:
            return None
        return min(first, size), min(last + 1, size)

    def _send_empty(self, status: HTTPStatus, headers: Mapping[str, str] | None = None) -> None:
        length = {} if status is HTTPStatus.NOT_MODIFIED else {"Content-Length": "0"}
        self._send_head(status, {**(headers or {}), **length})

    def _send_text(self, status: HTTPStatus, text: str, with_body: bool) -> None:
        body = text.encode()
        kind = {"Content-Type": "text/plain; charset=utf-8"} if text else {}
        self._send_head(status, {**kind, "Content-Length": str(len(body))})
        if with_body:
            self.wfile.write(body)

    def _send_head(self, status: HTTPStatus, headers: Mapping[str, str]) -> None:
        self.send_response(status)
        always = {
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",  # the URL contains the token
            "Cross-Origin-Resource-Policy": "same-origin",
        }
        for name, value in {**always, **self._web_server.headers, **headers}.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        _log.debug(format, *args)
