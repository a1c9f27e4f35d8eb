"""What machine this is, in words: never whose, nor what it is called."""

from __future__ import annotations

import os
import platform
from pathlib import Path


def processor_name() -> str:
    """As the processor calls itself, else the name of its architecture."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    for line in text.splitlines():
        key, _, value = line.partition(":")
        if key.strip() in ("model name", "Model") and value.strip():
            return " ".join(value.split())
    return platform.processor() or platform.machine() or "a processor without a name"


def memory_bytes() -> int:
    """Memory of the machine; 0 where the system does not tell."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return 0


def system_name() -> str:
    """Such as "Linux x86_64, Python 3.12"."""
    major, minor, *_ = platform.python_version_tuple()
    return f"{platform.system()} {platform.machine()}, Python {major}.{minor}"
