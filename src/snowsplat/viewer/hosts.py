"""Checks of the Host and Origin headers of requests, for both servers.

A web page elsewhere can make a domain name resolve to this machine (DNS rebinding), and any page
can make a browser connect to this machine. Browsers write the Host and Origin headers themselves,
so these reveal both attacks.
"""

from __future__ import annotations

import ipaddress
import re
import socket

#: Hosts that stand for all addresses of this machine.
ANY_HOST = ("", "0.0.0.0", "::")


def is_own_host(header: str, listening: str) -> bool:
    """Whether the Host header is a valid name of this machine for a server at ``listening``.

    The port is not compared, since it differs with SSH forwarding. A server on the loopback
    interface accepts loopback names only. Other servers also accept any IP address, since DNS
    rebinding needs a domain name.
    """
    match = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[^:\[\]]+)(?::\d*)?", header.strip())
    if match is None:
        return False
    name = match[1].strip("[]").rstrip(".").lower()
    if name in ("localhost", listening.lower()):
        return True
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return not is_loopback(listening) and name in _names_of_this_machine()
    return address.is_loopback or not is_loopback(listening)


def is_own_page(origin: str, host: str) -> bool:
    """Whether the requesting page was loaded from this server, by the Origin and Host headers."""
    return origin.lower() in (f"http://{host.lower()}", f"https://{host.lower()}")


def is_loopback(host: str) -> bool:
    """Whether a server at ``host`` is reachable from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _names_of_this_machine() -> set[str]:
    name = socket.gethostname().lower()
    return {name, name.partition(".")[0], f"{name.partition('.')[0]}.local"}
