"""Requests to pages of this computer, past any proxy: their addresses contain a secret."""

from __future__ import annotations

import urllib.request
from email.message import Message
from http.client import HTTPException

_open = urllib.request.build_opener(urllib.request.ProxyHandler({})).open


def read_local(url: str, seconds: float) -> tuple[Message, bytes]:
    """The headers and the content of the answer.

    Raises: OSError: there is no answer, or no whole one; ValueError: ``url`` is none.
    """
    try:
        with _open(url, timeout=seconds) as answer:
            return answer.headers, answer.read()
    except HTTPException as error:  # another program may have the port
        raise OSError(f"this is no answer of a page: {error!r}") from None
