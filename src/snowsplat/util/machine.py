"""This machine, without user name or host name; and the memory of this process."""

import gc
import os
import platform
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


def processor_name() -> str:
    """The model name of the processor, or the architecture if there is no name."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    for line in text.splitlines():
        key, _, value = line.partition(":")
        if key.strip() in ("model name", "Model") and value.strip():
            return " ".join(value.split())
    return platform.processor() or platform.machine() or "unknown processor"


def processor_count() -> int:
    """Number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def memory_bytes() -> int:
    """Memory of the machine in bytes; 0 if unknown."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return 0


def available_memory_bytes() -> int:
    """Memory that this process can still allocate, in bytes: the free memory of the machine without
    swap space, limited by the control group (container) of the process."""
    available = 4 << 30  # if the system does not report it
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        available = next(int(s.split()[1]) for s in lines if s.startswith("MemAvailable:")) << 10
    except (OSError, StopIteration, ValueError, IndexError):
        available = memory_bytes() // 2 or available
    for limit, used in (
        ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
        (
            "/sys/fs/cgroup/memory/memory.limit_in_bytes",
            "/sys/fs/cgroup/memory/memory.usage_in_bytes",
        ),
    ):
        try:
            left = int(Path(limit).read_text()) - int(Path(used).read_text())
        except (OSError, ValueError):  # no control group, or no limit ("max")
            continue
        available = min(available, max(left, 0))
    return available


def system_name() -> str:
    """System, architecture and Python version, for example "Linux x86_64, Python 3.12"."""
    major, minor, *_ = platform.python_version_tuple()
    return f"{platform.system()} {platform.machine()}, Python {major}.{minor}"
