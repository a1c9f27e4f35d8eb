"""A description of this machine, without user name or host name."""

from __future__ import annotations

import os
import platform
from pathlib import Path


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
