"""Checks of the Host and Origin headers of requests, for both servers.

The owner of a domain can make its name resolve to this machine (DNS rebinding), and any web page
can make a browser connect to this machine. The browser writes these headers, so they reveal both.
"""

from __future__ import annotations

import ipaddress
import logging
import re
import socket
from collections.abc import Sequence

from snowsplat.util.errors import SettingError

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
            return not is_loopback(self._listening) and name in _names_of_this_machine()
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


def _names_of_this_machine() -> set[str]:
    name = socket.gethostname().lower()
    return {name, name.partition(".")[0], f"{name.partition('.')[0]}.local"}
