"""Starts viser's server on a free port, without console output and with the checks of `Guard`."""

from __future__ import annotations

import contextlib
import errno
import io
import secrets
import socket
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import viser
import websockets.asyncio.server

from snowsplat.util.errors import SettingError
from snowsplat.viewer.hosts import ANY_HOST, KnownHosts
from snowsplat.viewer.live.guard import Guard

DEFAULT_PORT = 8080
_TRIED = 20  # ports that are tried if none is given


class _Server(viser.ViserServer):
    def request_share_url(self, verbose: bool = True) -> str | None:
        """Disabled: the page must not be published through viser's share service."""
        return None


@dataclass(frozen=True)
class RunningServer:
    """A server and its address."""

    server: viser.ViserServer
    url: str  # for browsers on this machine; with a host name, also for other machines
    others: list[str]  # the URLs for other machines, if they are different ones
    guard: Guard

    def open(self) -> None:
        """Accept browsers. From now on, change the page only through `call_in_server_thread`."""
        self.guard.is_open = True


def start_server(
    host: str, port: int | None, label: str, allow_host: Sequence[str] = ()
) -> RunningServer:
    """Start a server at ``host`` and ``port``; without a port, at 8080 or the next free one.

    ``label`` is the title of the page. Browsers are rejected until `RunningServer.open` is called.
    The URL contains a secret token. ``allow_host``: the names of proxies; see `KnownHosts`.
    Raises: UserError: the port is in use, the host is not an address of this machine, or an allowed
    name is none.
    """
    hosts = KnownHosts(host, allow_host)
    free = free_port(host, port)
    token = secrets.token_urlsafe(16)
    guard = Guard(hosts, token, f"{label} - snowsplat")
    # viser prints a welcome message, and warns about browsers that have disconnected.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    with contextlib.redirect_stdout(io.StringIO()), _guarded(guard):
        server = _Server(host=host, port=free, label=label, verbose=False)
    if not guard.serves:
        stop_server(server)
        raise RuntimeError(f"viser {viser.__version__} is not supported: it starts differently")
    listens = server.get_port()  # viser takes the next port if another process was faster
    if port is not None and listens != port:
        stop_server(server)
        raise SettingError("port", f"{port} is in use; choose another, e.g. {port + 1}")
    others = [address(socket.gethostname(), listens, token)] if host in ANY_HOST else []
    others += [f"https://{name}/{token}/" for name in hosts.allowed]
    return RunningServer(server, address(host, listens, token), others, guard)


@contextlib.contextmanager
def _guarded(guard: Guard) -> Iterator[None]:
    """Replaces the function with which viser listens, because viser has no setting for it."""
    serve = websockets.asyncio.server.serve
    websockets.asyncio.server.serve = guard.serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def stop_server(server: viser.ViserServer) -> None:
    """Close all connections and the port, silently."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def address(host: str, port: int, token: str) -> str:
    """The URL for browsers; ``host`` is the name or address of this machine."""
    shown = "localhost" if host in ANY_HOST else host
    return f"http://{f'[{shown}]' if ':' in shown else shown}:{port}/{token}/"


def free_port(host: str, port: int | None) -> int:
    """``port`` if it is free; without one, 8080 or the next free one.

    Raises: UserError: the port is in use, or the host is not an address of this machine.
    """
    if port is not None and not 0 < port < 65536:
        raise SettingError("port", f"{port} is out of range; use 1 to 65535")
    first = DEFAULT_PORT if port is None else port
    for candidate in range(first, first + (_TRIED if port is None else 1)):
        if _is_free(host, candidate):
            return candidate
    if port is not None:
        raise SettingError("port", f"{port} is in use; choose another, or do not set it")
    raise SettingError("port", f"{first} to {first + _TRIED - 1} are in use; choose another")


def _is_free(host: str, port: int) -> bool:
    """Whether the port is free. Raises UserError if this machine cannot listen at ``host``."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):
        raise SettingError(
            "host", f"{host} does not exist; 0.0.0.0 stands for all addresses of this machine"
        ) from None
    for family, kind, protocol, _, where in found:
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(where)
                probe.listen(1)
            except PermissionError:
                raise SettingError(
                    "port", f"no permission to use {port}; choose one above 1023"
                ) from None
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    return False
                raise SettingError(
                    "host",
                    f"cannot listen at {host} ({error.strerror}); 0.0.0.0 stands for all "
                    "addresses of this machine",
                ) from None
    return True
