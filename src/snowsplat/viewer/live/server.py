"""A viser server on this machine: quiet, on one port that is free, not to be shared by accident."""

from __future__ import annotations

import contextlib
import errno
import io
import secrets
import socket
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import viser
import websockets.asyncio.server

from snowsplat.util.errors import UserError
from snowsplat.viewer.hosts import ANY_HOST, is_loopback
from snowsplat.viewer.live.guard import Guard

DEFAULT_PORT = 8080
# How many ports are tried where none was asked for.
_TRIED = 20


class _Server(viser.ViserServer):
    def request_share_url(self, verbose: bool = True) -> str | None:
        """Nothing: a page may not publish what it shows through somebody's tunnel."""
        return None


@dataclass(frozen=True)
class Door:
    """A server, and the address that lets in.

    Attributes:
        url: for a browser on this machine, or on another where the host is this machine's name.
        others: for one on another computer, where that is let in and is another address.
    """

    server: viser.ViserServer
    url: str
    others: str | None
    guard: Guard

    def open(self) -> None:
        """Let browsers in; from now on the server is changed in its own thread, see `tell`."""
        self.guard.is_open = True


def start_server(host: str, port: int | None, label: str) -> Door:
    """Listen at ``host`` and ``port``; without one, at 8080 or the next that is free.

    Nobody is let in before `Door.open`. Where other machines reach it, only who has the address
    is.

    Raises:
        UserError: the port is taken, or the host is not one of this machine.
    """
    free = free_port(host, port)
    token = None if is_loopback(host) else secrets.token_urlsafe(16)
    guard = Guard(host, token)
    # Viser welcomes in the terminal by itself, and complains of browsers that left.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    with contextlib.redirect_stdout(io.StringIO()), _guarded(guard):
        server = _Server(host=host, port=free, label=label, verbose=False)
    if not guard.serves:
        stop_server(server)
        raise RuntimeError(f"viser {viser.__version__} starts its server in another way")
    if server.get_port() != free:  # taken since, and viser takes the next by itself
        stop_server(server)
        raise UserError(f"port {free} is taken; name another: --port {free + 1}")
    others = address(socket.gethostname(), free, token) if host in ANY_HOST else None
    return Door(server, address(host, free, token), others, guard)


@contextlib.contextmanager
def _guarded(guard: Guard) -> Iterator[None]:
    """Viser takes no word on how to listen, so what it listens with is ours meanwhile."""
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


def address(host: str, port: int, token: str | None = None) -> str:
    """For a browser on this machine, or on another where ``host`` is this machine's name there."""
    shown = "localhost" if host in ANY_HOST else host
    root = f"http://[{shown}]:{port}" if ":" in shown else f"http://{shown}:{port}"
    return root if token is None else f"{root}/{token}/"


def free_port(host: str, port: int | None) -> int:
    """``port`` if it is free; without one, 8080 or the next that is.

    Raises:
        UserError: the port is taken, or the host is not one of this machine.
    """
    if port is not None and not 0 < port < 65536:
        raise UserError(f"--port is {port}; it must be between 1 and 65535")
    first = DEFAULT_PORT if port is None else port
    for candidate in range(first, first + (_TRIED if port is None else 1)):
        if _is_free(host, candidate):
            return candidate
    if port is not None:
        raise UserError(f"port {port} is taken; name another, or leave out --port")
    raise UserError(f"ports {first} to {first + _TRIED - 1} are taken; name one with --port")


def _is_free(host: str, port: int) -> bool:
    """Raises: UserError: this machine cannot listen at ``host``, or not at this port."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError):
        raise UserError(f"--host {host}: no such host; 0.0.0.0 means all of this machine") from None
    for family, kind, protocol, _, where in found:
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(where)
                probe.listen(1)
            except PermissionError:
                raise UserError(
                    f"port {port} may not be used (permissions); name one above 1023"
                ) from None
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    return False
                raise UserError(
                    f"--host {host}: this machine cannot listen there ({error.strerror}); "
                    "0.0.0.0 means all of this machine"
                ) from None
    return True
