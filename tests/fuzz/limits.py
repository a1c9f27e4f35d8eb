"""What reading any file must keep to: time, memory, its folder; and that nothing is run.

`guarded` runs a reader under these limits in this process. It raises `Broken` where the reader
breaks one, and lets through what is no `UserError`.
"""

import contextlib
import dataclasses
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from snowsplat.util.errors import UserError

SECONDS = 10.0
MEMORY, RATIO = 64 << 20, 4  # bytes, and for each byte of the file and of what is read from it
_ADDRESS_SPACE = 6 << 30  # beyond what the process has: so that a defect does not end the machine

#: What a reader has no business with; `open` is looked at by itself.
_FORBIDDEN = (
    "pickle.find_class",
    "subprocess.Popen",
    "os.system",
    "os.exec",
    "os.spawn",
    "os.fork",
)
_FORBIDDEN += ("socket.connect", "socket.getaddrinfo", "urllib.Request", "ctypes.dlopen")
# Where libraries look for parts of themselves.
_ALLOWED = tuple({sys.prefix, sys.base_prefix, "/usr", "/proc", "/sys", "/dev/null", "/lib"})
_ALLOWED += tuple(os.path.realpath(path) for path in sys.path if path)
_ALLOWED += ("/etc/ld.so.cache", "/etc/nsswitch.conf")


class Broken(BaseException):
    """A limit that was broken. No `Exception`: readers catch those."""


class _Watch:
    """What the interpreter reports of what is opened and run, by the one hook that there may be."""

    home: str | None = None
    found: str | None = None
    thread = 0

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.home is None or self.thread != threading.get_ident() or self.found is not None:
            return
        if event in _FORBIDDEN:
            self.found = f"{event}{arguments!r:.100}"
        elif event == "open" and isinstance(arguments[0], (str, bytes)):
            path = os.path.realpath(os.fsdecode(arguments[0]))
            if not path.startswith((self.home, *_ALLOWED)):
                self.found = f"opened {path}"


_watch = _Watch()


def _watch_from_now_on() -> None:
    if not getattr(_watch, "hooked", False):
        sys.addaudithook(_watch)
        _watch.hooked = True  # type: ignore[attr-defined]


@contextlib.contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    def ring(*_: object) -> None:
        raise Broken(f"takes more than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def _address_limit() -> Iterator[None]:
    if sys.platform != "linux":
        yield
        return
    import resource

    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (now + _ADDRESS_SPACE, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _status(name: str) -> int:
    """Bytes, of a line of /proc/self/status."""
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) << 10 for line in file if line.startswith(name))


def measured(read: Callable[[], Any]) -> tuple[Any, int]:
    """What ``read`` gives, and how much more memory than before the process had meanwhile.

    Of the whole process, by the kernel's own high-water mark: torch, Pillow, FFmpeg count. 0 where
    the kernel does not tell.
    """
    try:
        with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
            file.write("5")
        before = _status("VmRSS")
    except OSError:
        return read(), 0
    result = read()
    return result, _status("VmHWM") - before


def bytes_of(value: Any) -> int:
    """Of the numbers, pixels and texts in it."""
    if isinstance(value, torch.Tensor | np.ndarray):
        return int(value.nbytes)
    if isinstance(value, Image.Image):
        return 4 * value.width * value.height
    if isinstance(value, str | bytes):
        return len(value)
    if dataclasses.is_dataclass(value):
        return sum(bytes_of(getattr(value, f.name)) for f in dataclasses.fields(value))
    if isinstance(value, dict):
        return sum(bytes_of(item) + 100 for item in value.values())
    if isinstance(value, list | tuple | set):
        return sum(bytes_of(item) + 8 for item in value)
    return 32


def guarded(read: Callable[[], Any], home: Path, size: int, extra: int = 0) -> Any:
    """What ``read`` gives, or the `UserError` that it raises, within all limits.

    Args:
        home: the folder that it may read.
        size: of the files in question.
        extra: bytes of memory that it may take beyond the general limit.

    Raises:
        Broken: it took too long or too much memory, left its folder, ran something, or told a
            mistake in more than one line.
        Exception: whatever else the reader raised: a defect, too.
    """
    _watch_from_now_on()

    def run() -> Any:
        try:
            return read()
        except UserError as error:
            return error

    _watch.home, _watch.found, _watch.thread = os.path.realpath(home), None, threading.get_ident()
    try:
        with _time_limit(SECONDS), _address_limit():
            result, used = measured(run)
    finally:
        _watch.home = None
    if _watch.found is not None:
        raise Broken(_watch.found)
    if isinstance(result, UserError):
        line = str(result)
        if "\n" in line or len(line) > 400 + 2 * len(str(home)):
            raise Broken(f"told at length: {line[:500]!r}")
    limit = MEMORY + RATIO * (size + bytes_of(result)) + extra
    if used > limit:
        # Pages of libraries that came back from the disk count too, but do so once.
        used = min(used, measured(run)[1])
    if used > limit:
        raise Broken(f"took {used >> 20} MB for a file of {size} bytes, {limit >> 20} MB may be")
    return result
