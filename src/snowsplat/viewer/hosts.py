"""By what names a server may be called, and which pages may call it: for both servers.

A name that somebody else owns can be made to point here (DNS rebinding), and any page on the web
can ask its browser to connect to this machine. Neither tells the truth about where it comes from,
but for these two headers: Host and Origin, which browsers write themselves.
"""

from __future__ import annotations

import ipaddress
import re
import socket

#: Hosts that mean all addresses of this machine.
ANY_HOST = ("", "0.0.0.0", "::")


def is_own_host(header: str, listening: str) -> bool:
    """Whether the Host of a request is a name of this machine, as seen by one who may ask.

    The port is not looked at: with SSH forwarding it is another one. A server that listens on this
    machine alone is called by its loopback names; one that listens to others also by any address,
    since only names can be made to point here.
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
    """Whether the page that asks came from where it asks, by the headers Origin and Host."""
    return origin.lower() in (f"http://{host.lower()}", f"https://{host.lower()}")


def is_loopback(host: str) -> bool:
    """Whether what listens there can be reached from this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _names_of_this_machine() -> set[str]:
    name = socket.gethostname().lower()
    return {name, name.partition(".")[0], f"{name.partition('.')[0]}.local"}
