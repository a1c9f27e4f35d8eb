"""Files for browsers, in memory or on disk, and an ASGI app that serves a table of them."""

import asyncio
import hashlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from urllib.parse import quote

from starlette.datastructures import Headers
from starlette.responses import FileResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

_BLOCK = 1 << 18  # bytes sent at once
_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".jpg": "image/jpeg",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".mp4": "video/mp4",
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
    ".webp": "image/webp",
}


@dataclass(frozen=True)
class ServedFile:
    """A file's bytes and its content type."""

    content: bytes = field(repr=False)
    type: str

    @cached_property
    def etag(self) -> str:
        return f'"{hashlib.sha256(self.content).hexdigest()[:32]}"'

    def response(self) -> Response:
        return _InBlocks(self.content, headers={"Content-Type": self.type, "ETag": self.etag})


@dataclass(frozen=True)
class FileOnDisk:
    """A file that is read when it is requested, also parts of it."""

    path: Path
    type: str

    def response(self) -> Response:
        """Raises: OSError: the file was removed."""
        headers = {"Content-Type": self.type}
        return _FromDisk(self.path, headers=headers, stat_result=os.stat(self.path))


Served = ServedFile | FileOnDisk


class _FromDisk(FileResponse):
    chunk_size = _BLOCK


class _InBlocks(Response):
    """Sends its content in blocks: a slow client has received one before the connection times out.
    Others are served in between."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        head = {"status": self.status_code, "headers": self.raw_headers}
        await send({"type": "http.response.start", **head})
        content = memoryview(self.body)
        for at in range(0, len(content), _BLOCK):
            block = content[at : at + _BLOCK]
            await send({"type": "http.response.body", "body": block, "more_body": True})
            await asyncio.sleep(0)
        await send({"type": "http.response.body"})


def content_type(file: Path) -> str:
    """The content type of a file, by its suffix."""
    return _TYPES.get(file.suffix, "application/octet-stream")


def served(folder: Path, files: Iterable[Path]) -> dict[str, Served]:
    """Files in a folder, by their quoted paths in it."""
    return {
        quote(file.relative_to(folder).as_posix()): FileOnDisk(file, content_type(file))
        for file in files
    }


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
        response = Response(status_code=405, headers={"Allow": "GET, HEAD"})
    elif file is None:
        response = Response(status_code=404)
    else:
        response = file.response()
        response.headers.update({"Cache-Control": "private, no-cache", **(more or {})})
        if response.headers["ETag"] in Headers(scope=scope).get("if-none-match", ""):
            kept = {k: v for k, v in response.headers.items() if k not in ("content-length",)}
            response = Response(status_code=304, headers=kept)
    await response(scope, receive, send)
