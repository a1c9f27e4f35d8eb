"""One studio per library, and its address: a second one finds the first.

Two servers would not know of each other's uploads, edits and removals. The lock is that of
`snowsplat.util.run_lock`. The address contains the secret of the page, so only its owner can read
the file.
"""

import json
import os
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from http.client import HTTPException
from pathlib import Path

from snowsplat.util.files import atomic_path, is_own
from snowsplat.util.run_lock import InUse, locked
from snowsplat.util.safe_json import from_json, parse_json, read_json

_LOCK = ".studio.lock"
_ADDRESS = ".studio.json"
_SECONDS = 3.0  # in which a studio answers
# Past any proxy, because the address of a page contains a secret.
_open = urllib.request.build_opener(urllib.request.ProxyHandler({})).open


@dataclass(frozen=True)
class Address:
    """Where a studio listens.

    Attributes:
        url: of its page, for a browser on this computer.
        host, port, token: as those of `WebServer`.
        others: URLs for other computers.
        opener: a file that leads a browser to it; see `snowsplat.cli.pages.opener_of`.
    """

    url: str
    host: str
    port: int
    token: str
    others: list[str]
    opener: str

    def answers(self, folder: Path) -> bool:
        """Whether it is there, and has this library."""
        try:
            with _open(f"{self.url}about", timeout=_SECONDS) as answer:
                about = parse_json(answer.read())
            return os.path.samefile(about["folder"], folder)
        except (OSError, HTTPException, ValueError, KeyError, TypeError):
            return False


class Running(InUse):
    """A studio serves the library already.

    Attributes:
        address: that of the studio.
    """

    def __init__(self, address: Address) -> None:
        super().__init__(f"the scenes are open already at {address.url}")
        self.address = address


def _address_in(folder: Path) -> Address | None:
    """What the studio of a library has written; None: nothing, or it is not that of this user."""
    file = folder / _ADDRESS
    try:
        # That of another user could lead the browser elsewhere.
        return from_json(Address, read_json(file)) if is_own(file) else None
    except (OSError, ValueError):
        return None


def write_address(folder: Path, address: Address) -> None:
    """Raises OSError: the folder is not writable."""
    with atomic_path(folder / _ADDRESS, private=True) as temporary:
        temporary.write_text(json.dumps(asdict(address)), "utf-8")


@contextmanager
def only_studio(folder: Path, wait: float = _SECONDS) -> Iterator[None]:
    """Hold the library during the block.

    A folder that cannot be written, such as that of another user to look at, needs no lock.
    ``wait``: seconds for a process that is just ending.

    Raises:
        Running: another studio has it, and answers.
        InUse: another one has it, and does not answer, or only to others.
    """
    if not os.access(folder, os.W_OK):
        yield
        return
    with ExitStack() as stack:
        for seconds in (0.0, wait):
            try:
                stack.enter_context(locked(folder / _LOCK, str(folder), seconds))
                break
            except InUse:
                # Only now: another program may have the port of a studio that was killed.
                _check_running(folder)
                if seconds == wait:
                    raise
        try:
            yield
        finally:
            with suppress(OSError):
                (folder / _ADDRESS).unlink(missing_ok=True)


def _check_running(folder: Path) -> None:
    address = _address_in(folder)
    if address is not None and address.answers(folder):
        raise Running(address)
