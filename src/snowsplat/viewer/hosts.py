"""Checks of the Host and Origin headers of requests, for both servers.

The owner of a domain can make its name resolve to this machine (DNS rebinding), and any web page
can make a browser connect to this machine. A page cannot change the Host and Origin headers, which
the browser writes. So these headers reveal both attacks.
"""

from __future__ import annotations

import ipaddress
import re
import socket

#: The address at which only this machine can connect.
LOCAL_HOST = "127.0.0.1"
#: Hosts that stand for all addresses of this machine.
ANY_HOST = ("", "0.0.0.0", "::")


def is_own_host(header: str, listening: str) -> bool:
    """Whether the Host header is a valid name of this machine for a server at ``listening``.

    The port is not compared, because it differs with SSH forwarding. A server on the loopback
    interface accepts only loopback names. Other servers also accept all IP addresses, because DNS
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
    """Whether, by the Origin and Host headers, the requesting page comes from this server."""
    return origin.lower() in (f"http://{host.lower()}", f"https://{host.lower()}")


def is_loopback(host: str) -> bool:
    """Whether a server at ``host`` can be reached only from this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _names_of_this_machine() -> set[str]:
    name = socket.gethostname().lower()
    return {name, name.partition(".")[0], f"{name.partition('.')[0]}.local"}
