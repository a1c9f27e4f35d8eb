"""Checks of the Host and Origin headers of requests, for both servers.

The owner of a domain can make its name resolve to this machine (DNS rebinding), and any web page
can make a browser connect to this machine. The browser writes these headers, so they reveal both.

`listen` opens a socket at an address of this machine, with an error message for each failure.
"""

import errno
import ipaddress
import logging
import re
import socket
import sys
from collections.abc import Sequence

from snowsplat.util.errors import SettingError, cause_of

#: The address at which only this machine can connect.
LOCAL_HOST = "127.0.0.1"
#: Hosts that stand for all addresses of this machine.
ANY_HOST = ("", "0.0.0.0", "::")
#: The answer to a request without the token of this start; browsers show it as it is.
NO_TOKEN = (
    "This address is incomplete, or that of an earlier start: open the whole URL that snowsplat "
    "has printed in its terminal; its path is a secret token.\n"
    "此地址不完整，或属于之前的一次启动：请打开 snowsplat 在终端中显示的完整网址，"
    "其路径是秘密令牌。\n"
)

_REPORTED = 8  # unknown names that are reported; strangers can send any number of them
_log = logging.getLogger(__name__)
DEFAULT_PORT = 8080
_TRIED = 20  # ports that are tried if none is given
#: Connections that the system keeps until they are accepted.
BACKLOG = 64


class KnownHosts:
    """The names at which a server may be asked for."""

    def __init__(self, listening: str, allowed: Sequence[str] = ()) -> None:
        """``listening``: the address of the server. ``allowed``: further names, such as that of a
        proxy; each may be several ones, separated by commas. Raises: UserError: one is no name.
        """
        self._listening = listening
        self.allowed = [_valid(name) for names in allowed for name in names.split(",")]
        self._reported: set[str] = set()

    def include(self, header: str) -> bool:
        """Whether the Host header is a valid name of this machine.

        The port is not compared, because it differs with SSH forwarding. A server on the loopback
        interface accepts only loopback names. Other servers also accept all IP addresses, because
        DNS rebinding needs a domain name.
        """
        name = _name(header)
        if name is None:
            return False
        if name in ("localhost", self._listening.lower(), *self.allowed):
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            own = socket.gethostname().lower()
            short = own.partition(".")[0]
            return not is_loopback(self._listening) and name in (own, short, f"{short}.local")
        return address.is_loopback or not is_loopback(self._listening)

    def include_page(self, origin: str, host: str) -> bool:
        """Whether, by the Origin and Host headers, the requesting page comes from this server.

        A proxy may replace the Host header, but not the Origin header: an allowed name is enough.
        """
        scheme, _, place = origin.lower().partition("://")
        if scheme not in ("http", "https"):
            return False
        return place == host.lower() or _name(place) in self.allowed

    def explain(self, header: str) -> str:
        """The answer to a request with an unknown Host header; each name is logged once."""
        name = _name(header)
        if name is None:
            return "The request has no valid Host header.\n"
        if name not in self._reported and len(self._reported) < _REPORTED:
            self._reported.add(name)
            _log.warning(
                "a browser asked for the page at the unknown name %s; if your proxy has this name, "
                "start again with --allow-host %s",
                name,
                name,
            )
        return (
            f"snowsplat does not know the name {name}, and shows nothing at unknown names.\n"
            f"If this is the name of your proxy, start snowsplat again with --allow-host {name}\n"
        )


def is_loopback(host: str) -> bool:
    """Whether a server at ``host`` can be reached only from this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _name(header: str) -> str | None:
    """The host of a Host header, without the port and in lower case; None if it is malformed."""
    match = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]{1,253})(?::\d*)?", header.strip())
    return match and match[1].strip("[]").rstrip(".").lower()


def _valid(allowed: str) -> str:
    try:
        name = _name(allowed.strip().encode("idna").decode())
    except UnicodeError:
        name = None
    if not name:
        raise SettingError(
            "allow_host",
            "{allowed!r} is not a host name; use that of the address in the browser, without "
            "https:// and path",
            allowed=allowed,
        )
    return name


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
        # Connections inherit it: one whose phone has left the network ends after some hours.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
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
