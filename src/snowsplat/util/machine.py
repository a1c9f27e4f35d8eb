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


def memory_bytes() -> int:
    """Memory of the machine in bytes; 0 if unknown."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return 0


def system_name() -> str:
    """System, architecture and Python version, for example "Linux x86_64, Python 3.12"."""
    major, minor, *_ = platform.python_version_tuple()
    return f"{platform.system()} {platform.machine()}, Python {major}.{minor}"
