"""The limits of every reader: time, memory, its own folder, and no execution of programs.

`guarded` runs a reader in this process under these limits. It raises `Broken` if the reader exceeds
one. It returns a `UserError` of the reader; any other exception passes through.
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

#: Time limit.
SECONDS = 10.0
#: Memory limit in bytes: MEMORY, and RATIO for each byte of the file and of the result.
MEMORY = 64 << 20
RATIO = 4
# Address space in bytes beyond the current size, so that a defect does not exhaust the machine.
_ADDRESS_SPACE = 6 << 30

#: Audit events that readers must not cause. The event `open` is checked separately.
_FORBIDDEN = (
    "pickle.find_class",
    "subprocess.Popen",
    "os.system",
    "os.exec",
    "os.spawn",
    "os.fork",
)
_FORBIDDEN += ("socket.connect", "socket.getaddrinfo", "urllib.Request", "ctypes.dlopen")
# Paths where libraries find their own files.
_ALLOWED = tuple({sys.prefix, sys.base_prefix, "/usr", "/proc", "/sys", "/dev/null", "/lib"})
_ALLOWED += tuple(os.path.realpath(path) for path in sys.path if path)
_ALLOWED += ("/etc/ld.so.cache", "/etc/nsswitch.conf")


class Broken(BaseException):
    """A reader exceeded a limit. Not an `Exception`, because readers catch those."""


class _Watch:
    """An audit hook: it finds forbidden events and opened files. Hooks cannot be removed."""

    home: str | None = None  # the folder that may be read; None: the hook is inactive
    found: str | None = None  # the first violation
    thread = 0  # the thread to watch

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


def _install_watch() -> None:
    if not getattr(_watch, "hooked", False):
        sys.addaudithook(_watch)
        _watch.hooked = True  # type: ignore[attr-defined]


@contextlib.contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    """A limit of the processor time; what waits, as for a pipe, gets 30 times as long."""

    def expire(*_: object) -> None:
        raise Broken(f"takes more than {seconds:g} s")

    timers = {signal.ITIMER_PROF: signal.SIGPROF, signal.ITIMER_REAL: signal.SIGALRM}
    before = {number: signal.signal(number, expire) for number in timers.values()}
    signal.setitimer(signal.ITIMER_PROF, seconds)
    signal.setitimer(signal.ITIMER_REAL, 30 * seconds)
    try:
        yield
    finally:
        for timer, number in timers.items():
            signal.setitimer(timer, 0)
            signal.signal(number, before[number])


@contextlib.contextmanager
def address_limit(most: int = _ADDRESS_SPACE) -> Iterator[None]:
    """Limit the address space of this process to ``most`` bytes more than now (on Linux)."""
    if sys.platform != "linux":
        yield
        return
    import resource

    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (now + most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _status(name: str) -> int:
    """The value of a line of /proc/self/status, in bytes."""
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) << 10 for line in file if line.startswith(name))


def measured(read: Callable[[], Any]) -> tuple[Any, int]:
    """The result of ``read``, and the increase of the peak memory of the process in bytes.

    The kernel measures the peak of the complete process, including torch, Pillow and FFmpeg. The
    increase is 0 if the kernel does not support this.
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
    """Approximate size of the numbers, pixels and texts in ``value``, in bytes."""
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
    """The result of ``read``, or the `UserError` that it raised, if it respected all limits.

    Args:
        read: calls the reader.
        home: the folder that the reader may access.
        size: size of its files in bytes.
        extra: additional memory that is allowed, in bytes.

    Raises:
        Broken: the reader took too long or too much memory, opened a file outside its folder,
            executed a program, or its error message has more than one line or is too long.
        Exception: any other exception of the reader; this is a defect too.
    """
    _install_watch()

    def run() -> Any:
        try:
            return read()
        except UserError as error:
            return error

    _watch.home, _watch.found, _watch.thread = os.path.realpath(home), None, threading.get_ident()
    try:
        with _time_limit(SECONDS), address_limit():
            result, used = measured(run)
    finally:
        _watch.home = None
    if _watch.found is not None:
        raise Broken(_watch.found)
    if isinstance(result, UserError):
        line = str(result)
        if "\n" in line or len(line) > 400 + 2 * len(str(home)):
            raise Broken(f"long message: {line[:500]!r}")
    limit = MEMORY + RATIO * (size + bytes_of(result)) + extra
    if used > limit:
        # Memory pages of libraries that are loaded from disk also count, but only in the first run.
        used = min(used, measured(run)[1])
    if used > limit:
        raise Broken(f"took {used >> 20} MB for a file of {size} bytes; allowed: {limit >> 20} MB")
    return result
