"""`listen`: a socket at an address of this machine, with an error message for each failure."""

from __future__ import annotations

import errno
import socket
import sys

from snowsplat.util.errors import SettingError, cause_of

DEFAULT_PORT = 8080
_TRIED = 20  # ports that are tried if none is given
#: Connections that the system keeps until they are accepted.
BACKLOG = 64


def listen(host: str, port: int | None) -> socket.socket:
    """A listening socket; port 0 is any free port, None is 8080 or the next free one.

    Raises: UserError: the port is in use or not permitted, or the host is not an address of this
    machine.
    """
    if port is not None:
        return _listen(host, port)
    last = DEFAULT_PORT + _TRIED - 1
    for candidate in range(DEFAULT_PORT, last + 1):
        try:
            return _listen(host, candidate)
        except _InUse:
            continue
    raise SettingError(
        "port",
        "{default_port} to {last} are in use; choose another",
        default_port=DEFAULT_PORT,
        last=last,
    )


class _InUse(SettingError):
    pass


def _listen(host: str, port: int) -> socket.socket:
    if not 0 <= port < 65536:
        raise SettingError("port", "{port} is out of range; use 0 to 65535", port=port)
    try:
        found = socket.getaddrinfo(
            host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
    except (OSError, UnicodeError):
        raise SettingError(
            "host", "{host} is not a name or address of this machine; use e.g. 127.0.0.1", host=host
        ) from None
    # A name with addresses of both kinds, such as localhost: browsers try both.
    family, kind, protocol, _, where = min(found, key=lambda each: each[0] != socket.AF_INET)
    listener = socket.socket(family, kind, protocol)
    try:
        if sys.platform != "win32":  # there, two servers could then listen on the same port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(where)
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        if isinstance(error, PermissionError):
            raise SettingError(
                "port", "no permission to use {port}; choose one above 1023", port=port
            ) from None
        if error.errno == errno.EADDRINUSE:
            raise _InUse(
                "port",
                "{port} is in use; choose another, or omit it: then a free one is used",
                port=port,
            ) from None
        raise SettingError(
            "host",
            "cannot listen at {host} ({strerror}); use e.g. 127.0.0.1",
            host=host,
            strerror=cause_of(error),
        ) from None
    return listener
