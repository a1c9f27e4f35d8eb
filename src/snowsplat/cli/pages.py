"""Pages in the browser: their addresses for other computers, and how they are opened."""

from __future__ import annotations

import getpass
import os
import socket
import sys
import threading
import time
from collections.abc import Sequence
from urllib.parse import urlsplit

from snowsplat.util.messages import message
from snowsplat.viewer.hosts import LOCAL_HOST


def for_other_computers(url: str, others: Sequence[str]) -> list[str]:
    """Lines that say how other computers open a page: at its other addresses or, if it is only for
    this computer and this shell is a remote one, through a forwarded port."""
    here = urlsplit(url)
    if here.hostname == LOCAL_HOST and not others and over_ssh():
        return [f"from your computer: {_forwarding(here.port)}"]
    return [f"from other computers: {other}" for other in others]


def over_ssh() -> bool:
    """Whether this shell is a remote one."""
    return any(name in os.environ for name in ("SSH_CONNECTION", "SSH_TTY"))


def has_screen() -> bool:
    """Whether a browser opened here has a screen; otherwise a text browser would take the shell."""
    if sys.platform in ("win32", "darwin"):
        return not over_ssh()
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def _forwarding(port: int | None) -> str:
    """The command that forwards a port of this machine to the computer of the user."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # in containers, a user may have a number only
        user = "USER"
    return f"ssh -L {port}:{LOCAL_HOST}:{port} {user}@{socket.gethostname()}"


def show(how: str, url: str, others: Sequence[str], browser: bool) -> None:
    """Print the addresses of a page, and open it if there is a ``browser`` and a screen."""
    print(message("{how}: {url}", how=how, url=url), flush=True)
    for line in for_other_computers(url, others):
        print(line, flush=True)
    if browser and has_screen():
        open_browser(url)


def open_browser(url: str) -> None:
    """In the background: some browsers block the program that opens them."""
    import webbrowser

    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()


def wait() -> None:
    """Wait for Ctrl-C, which arrives only between two waits on Windows."""
    while True:
        time.sleep(1.0)
