"""A viser server on this machine: quiet, on one port that is free, not to be shared by accident."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import ipaddress
import re
import socket
import warnings
from collections.abc import Iterator

import viser
import websockets.asyncio.server

from snowsplat.errors import UserError

DEFAULT_PORT = 8080
# How many ports are tried where none was asked for.
_TRIED = 20


# Pages that may connect to a server of this computer alone: its own, by whatever port they came
# through SSH, and programs that are no browsers. Any page on the web could try to.
_OWN_PAGES = (re.compile(r"http://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"), None)


class _Server(viser.ViserServer):
    def request_share_url(self, verbose: bool = True) -> str | None:
        """Nothing: a page may not publish what it shows through somebody's tunnel."""
        return None


def start_server(host: str, port: int | None, label: str) -> viser.ViserServer:
    """Listen at ``host`` and ``port``; without one, at 8080 or the next that is free.

    Raises:
        UserError: the port is taken, or the host is not one of this machine.
    """
    free = free_port(host, port)
    # Viser welcomes in the terminal by itself, and complains of browsers that left.
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    with contextlib.redirect_stdout(io.StringIO()), _refusing_other_pages(host):
        server = _Server(host=host, port=free, label=label, verbose=False)
    if server.get_port() != free:  # taken since, and viser takes the next by itself
        stop_server(server)
        raise UserError(f"port {free} is taken; name another: --port {free + 1}")
    return server


@contextlib.contextmanager
def _refusing_other_pages(host: str) -> Iterator[None]:
    """Viser has no word for it, so what it starts its server with is given one meanwhile."""
    serve = websockets.asyncio.server.serve
    if _is_local(host):
        refusing = functools.partial(serve, origins=_OWN_PAGES)
        websockets.asyncio.server.serve = refusing  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _is_local(host: str) -> bool:
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def stop_server(server: viser.ViserServer) -> None:
    """Close all connections and the port, silently."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def address(host: str, port: int) -> str:
    """For a browser on this machine, or on another where ``host`` is this machine's name there."""
    shown = {"": "localhost", "0.0.0.0": "localhost", "::": "localhost"}.get(host, host)
    return f"http://[{shown}]:{port}" if ":" in shown else f"http://{shown}:{port}"


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
