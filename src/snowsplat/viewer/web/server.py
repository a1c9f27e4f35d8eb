"""A small web server for one page: some files in memory, for the browsers of one person.

It serves what it was given and nothing else: names are looked up, never opened. Its address has a
part that cannot be guessed, and requests that name a foreign host are refused: a web page elsewhere
cannot reach it through a name that it makes point here (DNS rebinding).
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
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
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import Any, cast

from snowsplat.util.errors import UserError
from snowsplat.viewer.hosts import ANY_HOST, is_own_host, is_own_page

_BLOCK = 1 << 18  # bytes sent at once
# Seconds after which a connection is closed that asks nothing, whose request is not all there, that
# does not take a block.
_IDLE_SECONDS, _REQUEST_SECONDS, _SEND_SECONDS = 60.0, 10.0, 60.0
_REQUEST = 16 << 10  # bytes of a request at most
# Connections open at once. A new one takes the place of the oldest of those that have not been
# answered anything but refusals; where there is none, it is closed.
_CONNECTIONS = 256
# A line that asks and lines of headers, as the protocol has them and in no other way: what one
# reader takes for the end of a request, another might not.
_HEAD = re.compile(
    rb"[!-~]+ [!-~]+ HTTP/1\.[01](\r\n[!#$%&'*+.^_`|~0-9A-Za-z-]+:[\t -~\x80-\xff]*)*\r\n\r\n"
)
_RANGE = re.compile(r"bytes=(\d*)-(\d*)")

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ServedFile:
    """A file's bytes and its content type."""

    content: bytes = field(repr=False)
    type: str

    @cached_property
    def etag(self) -> str:
        return f'"{hashlib.sha256(self.content).hexdigest()[:32]}"'


class StaticServer:
    """Serves ``files`` by name ("" is the page itself) from the time it is made, until `close`.

    Every response carries the headers ``headers`` too.

    Raises:
        UserError: the port is taken or not allowed, the host is no address of this machine.
    """

    def __init__(
        self,
        files: Mapping[str, ServedFile],
        headers: Mapping[str, str],
        host: str = "127.0.0.1",
        port: int = 0,
    ) -> None:
        self.host = host
        self._token = secrets.token_urlsafe(16)
        self._server = _listen(host, port)
        self._server.prefix = f"/{self._token}/"
        self._server.files = dict(files)
        self._server.headers = dict(headers)
        self._server.host = host
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        return int(self._server.server_address[1])

    @property
    def url(self) -> str:
        """The page's address, for a browser on this machine."""
        return self.url_at("127.0.0.1" if self.host in ANY_HOST else self.host)

    def url_at(self, host: str) -> str:
        """The page's address for those who call this machine ``host``."""
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/{self._token}/"

    def close(self) -> None:
        """Stop; downloads under way are cut off."""
        self._server.shutdown()
        self._server.server_close()
        self._server.hang_up()

    def __enter__(self) -> StaticServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Server(socketserver.ThreadingTCPServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = sys.platform != "win32"  # there it would share a port that is taken
    request_queue_size = 64

    prefix: str
    files: dict[str, ServedFile]
    headers: dict[str, str]
    host: str

    def __init__(self, *args: Any) -> None:
        self._lock = threading.Lock()
        self._strangers: dict[socket.socket, None] = {}  # in the order in which they came
        self._known: set[socket.socket] = set()  # have been given something
        super().__init__(*args)

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether there is room for a connection."""
        with self._lock:
            if len(self._strangers) + len(self._known) >= _CONNECTIONS:
                if not self._strangers:
                    return False
                oldest = next(iter(self._strangers))
                del self._strangers[oldest]
                _hang_up(oldest)  # its thread sees that, and ends
            self._strangers[request] = None
            return True

    def know(self, request: socket.socket) -> None:
        """This one has the address."""
        with self._lock:
            if request in self._strangers:
                del self._strangers[request]
                self._known.add(request)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._strangers.pop(request, None)
            self._known.discard(request)
        super().shutdown_request(request)

    def hang_up(self) -> None:
        """Cut all connections off."""
        with self._lock:
            for request in (*self._strangers, *self._known):
                _hang_up(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        # A browser that leaves in the middle of a download is not an error.
        error = sys.exc_info()[1]
        if not isinstance(error, ConnectionError | TimeoutError):
            _log.error("the viewer's server: %s: %s", type(error).__name__, error)


def _hang_up(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class _Server6(_Server):
    address_family = socket.AF_INET6


def _listen(host: str, port: int) -> _Server:
    try:
        return (_Server6 if ":" in host else _Server)((host, port), _Handler)
    except OverflowError:
        raise UserError(f"--port is {port}; it must be 0 to 65535") from None
    except PermissionError:
        raise UserError(f"port {port} is not allowed to you; name one above 1023") from None
    except socket.gaierror:
        raise UserError(f"{host}: not a name or address of this machine") from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise UserError(
                f"port {port} is taken; name another, or leave --port out for a free one"
            ) from None
        raise UserError(f"{host}: cannot be listened on ({error.strerror})") from None


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version = "snowsplat"
    sys_version = ""
    timeout = _SEND_SECONDS

    def setup(self) -> None:
        super().setup()
        self._received = b""

    def handle_one_request(self) -> None:
        """As the library's, but for a request that is all there, in its time and of its size."""
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
        """The next request as far as its empty line, or too much of one; None: it does not come."""
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
        self.close_connection = True  # its body was not read
        self._send_empty(HTTPStatus.METHOD_NOT_ALLOWED, {"Allow": "GET, HEAD"})

    @property
    def _ours(self) -> _Server:
        return cast(_Server, self.server)

    def _answer(self, with_body: bool) -> None:
        refusal = self._refusal()
        if refusal is not None:
            self._send_empty(refusal)
            return
        file = self._file()
        if file is None:
            self._send_empty(HTTPStatus.NOT_FOUND)
            return
        self._ours.know(self.connection)
        common = {"ETag": file.etag, "Cache-Control": "private, no-cache", "Accept-Ranges": "bytes"}
        if file.etag in (self.headers.get("If-None-Match") or ""):
            self._send_empty(HTTPStatus.NOT_MODIFIED, common)
            return
        size = len(file.content)
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
            content = memoryview(file.content)
            for at in range(start, end, _BLOCK):
                self.wfile.write(content[at : min(at + _BLOCK, end)])

    def _refusal(self) -> HTTPStatus | None:
        """Why a request is not looked at."""
        hosts, origins = (self.headers.get_all(name, []) for name in ("Host", "Origin"))
        # What has a body, or might have one to somebody else, would be two requests to us.
        bodies = (
            self.headers.get_all("Content-Length", []),
            self.headers.get_all("Transfer-Encoding", []),
        )
        if len(hosts) > 1 or len(origins) > 1 or bodies not in (([], []), (["0"], [])):
            self.close_connection = True
            return HTTPStatus.BAD_REQUEST
        host = hosts[0] if hosts else ""
        if not is_own_host(host, self._ours.host):
            return HTTPStatus.MISDIRECTED_REQUEST
        if not all(is_own_page(origin, host) for origin in origins):
            return HTTPStatus.FORBIDDEN
        return None

    def _file(self) -> ServedFile | None:
        """What the path names, taken as it stands: no name of ours needs decoding."""
        path = self.path.partition("?")[0]
        prefix = self._ours.prefix
        start, name = path[: len(prefix)], path[len(prefix) :]
        if not hmac.compare_digest(start.encode(), prefix.encode()):
            return None
        return self._ours.files.get(name)

    def _range(self, file: ServedFile) -> tuple[int, int] | None:
        """First byte asked for and the one after the last; None: the whole file.

        A range that the file does not have is empty. Several ranges at once, and what is no range,
        are answered by the whole file, as the protocol allows.
        """
        match = _RANGE.fullmatch(self.headers.get("Range", "").replace(" ", ""))
        if match is None or match[0] == "bytes=-":
            return None
        if self.headers.get("If-Range", file.etag) != file.etag:
            return None
        size = len(file.content)
        # A number with thousands of digits is refused by int(); any of these is past the end.
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

    def _send_head(self, status: HTTPStatus, headers: Mapping[str, str]) -> None:
        self.send_response(status)
        always = {
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",  # the address is a secret
            "Cross-Origin-Resource-Policy": "same-origin",
        }
        for name, value in {**always, **self._ours.headers, **headers}.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        _log.debug(format, *args)
