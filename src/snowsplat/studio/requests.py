"""What the answers to requests have in common: the studio, files, JSON, errors."""

import asyncio
from collections import defaultdict
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.types import Receive, Scope, Send

from snowsplat.project.studio_scene import StudioScene
from snowsplat.studio import job
from snowsplat.studio.library import Library, UnknownScene
from snowsplat.studio.texts import in_languages
from snowsplat.studio.uploads import NoSpace, WrongPart
from snowsplat.util.errors import UserError, message_of
from snowsplat.util.safe_json import is_file
from snowsplat.viewer.http.static import FileOnDisk, content_type, send_file


@dataclass(frozen=True)
class Studio:
    """What the answers share.

    Attributes:
        addresses: the URLs of the page for other machines.
        locks: by scene ("": all) and kind of work: a second request waits for the first one.
    """

    library: Library
    addresses: Callable[[], list[str]]
    locks: dict[tuple[str, str], asyncio.Lock] = field(
        default_factory=lambda: defaultdict(asyncio.Lock)
    )


#: The answer to a request about a scene: a value of JSON, or a response.
SceneAnswer = Callable[[Studio, Request, StudioScene], Awaitable[Any]]
#: Path, method, and answer; the path is that below /scenes/NAME.
SceneRoutes = tuple[tuple[str, str, SceneAnswer], ...]


# Whatever a stranger has written into a folder has no origin, no script and no style.
_SANDBOX = "sandbox; default-src 'none'"
# The other kinds, such as HTML, SVG and scripts, could act for the page of the studio.
_DATA = (".jpg", ".json", ".mp4", ".png", ".webp")


class File:
    """A response with a file of this package, and further headers."""

    def __init__(self, path: Path, **headers: str) -> None:
        self._path, self._headers = path, headers

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        file = FileOnDisk(self._path, self._type()) if is_file(self._path) else None
        await send_file(file, scope, receive, send, self._headers)

    def _type(self) -> str:
        return content_type(self._path)


class Data(File):
    """A response with a file of the library: browsers show it as a picture, or keep it."""

    def __init__(self, path: Path, **headers: str) -> None:
        super().__init__(path, **{"Content-Security-Policy": _SANDBOX, **headers})

    def _type(self) -> str:
        return super()._type() if self._path.suffix in _DATA else "application/octet-stream"


def answering(answer: Callable[[Request], Awaitable[Any]]) -> Callable[[Request], Awaitable[Any]]:
    """An endpoint: what ``answer`` returns as JSON, or its error."""

    async def endpoint(request: Request) -> Any:
        try:
            value = await answer(request)
            fresh = {"Cache-Control": "no-store"}
            return value if callable(value) else JSONResponse(value, headers=fresh)
        except WrongPart as error:
            return JSONResponse({"error": in_languages(error), "received": error.received}, 409)
        except UserError as error:
            codes = {UnknownScene: 404, NoSpace: 507}
            return JSONResponse({"error": in_languages(error)}, codes.get(type(error), 400))
        except OSError as error:
            return JSONResponse({"error": in_languages(message_of(error))}, 500)

    return endpoint


async def json_object(request: Request) -> dict[str, Any]:
    try:
        wanted = await request.json()
    except (ValueError, RecursionError):
        wanted = None
    if not isinstance(wanted, dict):
        raise UserError("the request is no JSON object")
    return wanted


def whole_number(text: str | None) -> int:
    if text is None or not (text.isascii() and text.isdecimal()) or len(text) > 18:
        raise UserError("size, modified and start are whole numbers")
    return int(text)


def version_of_page(request: Request) -> str:
    """That of the scene which the page shows."""
    return request.query_params.get("version", "")


async def film_has_read(scene: StudioScene) -> None:
    """Wait until a film that has started has read the scene: it shows the scene as it was then."""
    while job.is_running(scene, "film") and "now" not in scene.state("film"):
        await asyncio.sleep(0.1)


def file_inside(folder: Path, path: str) -> Path:
    """A file in a folder. Raises UnknownScene: the path leads elsewhere."""
    try:
        file = (folder / path).resolve()
        inside = file.is_relative_to(folder.resolve())
    except (OSError, ValueError):
        inside = False
    if not inside:
        raise UnknownScene("there is no such file")
    return file
