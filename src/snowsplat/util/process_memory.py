"""The memory of this process: the present resident memory and its peak."""

from __future__ import annotations

import gc
import sys
from contextlib import suppress
from pathlib import Path


def resident_bytes() -> int:
    """The present resident memory; if the system does not report it, the same as `peak_bytes`."""
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * resource.getpagesize()
    except (ImportError, OSError, ValueError, IndexError):
        pass
    return peak_bytes()


def peak_bytes() -> int:
    """The largest resident memory so far, or since `reset_peak`; 0 if it is not reported."""
    try:
        # getrusage is not used, because on Linux it starts with the peak of the parent process.
        lines = Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) << 10
    except (OSError, StopIteration, ValueError, IndexError):
        pass
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def return_unused() -> None:
    """Return freed memory to the system (on Linux); the allocator of the C library keeps it."""
    gc.collect()
    with suppress(OSError, AttributeError, TypeError):  # another C library
        import ctypes

        ctypes.CDLL(None).malloc_trim(0)


def reset_peak() -> None:
    """Return unused memory to the system, and reset `peak_bytes` to the resident memory (on Linux).

    If freed memory were not returned first, that of an earlier task would count for the next one.
    """
    return_unused()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
