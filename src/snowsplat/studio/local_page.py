"""Requests to pages of this computer, past any proxy: their addresses contain a secret."""

from __future__ import annotations

import urllib.request
from typing import Any

_open = urllib.request.build_opener(urllib.request.ProxyHandler({})).open


def open_local(url: str, seconds: float) -> Any:
    """The answer, an open file with ``headers``. Raises: OSError; ValueError: ``url`` is none."""
    return _open(url, timeout=seconds)
