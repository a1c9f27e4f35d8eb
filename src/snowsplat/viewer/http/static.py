"""An ASGI app that serves a table of files, with entity tags and ranges."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Mapping

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from snowsplat.viewer.http.served_file import Served

_RANGE = re.compile(r"bytes=(\d*)-(\d*)")


def static_app(files: Mapping[str, Served]) -> ASGIApp:
    """Serves only ``files``, by name ("" is the page itself).

    A requested name is looked up in the table, and is never used as a path.
    """

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await Response(status_code=404)(scope, receive, send)
            return
        # The path is not decoded, because all names are ASCII.
        file = files.get(scope["raw_path"].decode("ascii").removeprefix("/"))
        await send_file(file, scope, receive, send)

    return answer


async def send_file(
    file: Served | None,
    scope: Scope,
    receive: Receive,
    send: Send,
    more: Mapping[str, str] | None = None,
) -> None:
    """Answer a GET or HEAD request with a file; without one, with 404. ``more``: headers."""
    if scope["method"] not in ("GET", "HEAD"):
        refusal = Response(status_code=405, headers={"Allow": "GET, HEAD"})
        return await refusal(scope, receive, send)
    if file is None:
        return await Response(status_code=404)(scope, receive, send)
    headers = Headers(scope=scope)
    common = {"ETag": file.etag, "Cache-Control": "private, no-cache", "Accept-Ranges": "bytes"}
    common |= more or {}
    if file.etag in headers.get("if-none-match", ""):
        return await Response(status_code=304, headers=common)(scope, receive, send)
    size = file.size
    part = _range(headers, file)
    if part is None:
        status, start, end = 200, 0, size
    elif part[0] < part[1]:
        status, (start, end) = 206, part
        common["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
    else:
        refused = {**common, "Content-Range": f"bytes */{size}"}
        return await Response(status_code=416, headers=refused)(scope, receive, send)
    common |= {"Content-Type": file.type, "Content-Length": str(end - start)}
    raw = [(name.lower().encode(), value.encode("latin-1")) for name, value in common.items()]
    await send({"type": "http.response.start", "status": status, "headers": raw})
    if scope["method"] == "GET":
        for block in file.blocks(start, end):
            await send({"type": "http.response.body", "body": block, "more_body": True})
            await asyncio.sleep(0)  # serves others, even if this client reads at once
    await send({"type": "http.response.body"})


def _range(headers: Headers, file: Served) -> tuple[int, int] | None:
    """The first requested byte, and the byte after the last; None: the complete file.

    A range outside of the file is empty. For multiple or malformed ranges, the complete file is
    sent, as the protocol allows.
    """
    match = _RANGE.fullmatch(headers.get("range", "").replace(" ", ""))
    if match is None or match[0] == "bytes=-":
        return None
    if headers.get("if-range", file.etag) != file.etag:
        return None
    size = file.size
    # int() rejects numbers with thousands of digits; 19 digits are past the end anyway.
    first, last = (int(digits[:19]) if digits else None for digits in match.groups())
    if first is None:
        return max(0, size - (last or 0)), size
    if last is None:
        return min(first, size), size
    if last < first:
        return None
    return min(first, size), min(last + 1, size)
