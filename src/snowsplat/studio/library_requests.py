"""Requests about the library: the page, its addresses, folders of this machine, all scenes."""

import asyncio
import os
import socket
from collections.abc import Awaitable, Callable
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urljoin

import segno
from starlette.requests import Request

from snowsplat.data.photos.suffixes import VIDEO_SUFFIXES
from snowsplat.studio import job
from snowsplat.studio.picture_requests import SUFFIXES
from snowsplat.studio.requests import File, Studio, json_object
from snowsplat.studio.scene_requests import summary
from snowsplat.util.errors import UserError, cause_of
from snowsplat.util.html import THEME
from snowsplat.util.safe_json import printable
from snowsplat.viewer.http.guard import LOOK

_PAGES = Path(__file__).parent / "pages"
_FOLDERS = 500  # that are listed
# The endings of the files that are listed: videos, zip files, and finished scenes.
_SCENES = {".ply", ".spz", ".sog", ".splat", ".ksplat", ".glb", ".usdz"}
_FILES = VIDEO_SUFFIXES | {".zip"} | _SCENES


async def page(studio: Studio, request: Request) -> Any:
    return File(page_files()[request.url.path.strip("/")])


async def about(studio: Studio, request: Request) -> Any:
    path = request.query_params.get("path", "")
    # Phones may look at this scene, no more. The path is that of an address: "a%20b" is "a b".
    look = request.scope[LOOK](unquote(path))
    urls = [urljoin(url, f"../{look}/{path}") for url in studio.addresses()]
    codes = [segno.make(url, error="m").svg_data_uri(scale=4, border=2) for url in urls]
    return {
        "folder": str(studio.library.folder),
        "look": f"../{look}/{path}",  # relative to the page
        "addresses": [{"url": u, "code": c} for u, c in zip(urls, codes, strict=True)],
    }


async def browse(studio: Studio, request: Request) -> Any:
    path = request.query_params.get("path") or str(studio.library.folder.parent)
    return listing(Path(os.path.expanduser(path)))


async def scenes(studio: Studio, request: Request) -> Any:
    # A lock of another computer takes seconds to judge.
    scenes = studio.library.scenes()
    return await asyncio.to_thread(lambda: [summary(scene) for scene in scenes])


async def new(studio: Studio, request: Request) -> Any:
    wanted = await json_object(request)
    path = str(wanted.get("path") or "").strip()
    inputs = [Path(os.path.expanduser(path))] if path else []
    if inputs and not inputs[0].is_absolute():
        raise UserError(
            "{path}: write the whole path, such as /home/me/photos", path=printable(path)
        )
    names = [path.name if is_folder(path) else path.stem for path in inputs]
    title = str(wanted.get("title") or "".join(names))
    scene = studio.library.new(title, inputs)
    if wanted.get("example") is True:
        scene.change(example=True, quality="draft")
        job.start(scene)
    return {"name": scene.name}


#: Path, method, and answer.
ROUTES: tuple[tuple[str, str, Callable[[Studio, Request], Awaitable[Any]]], ...] = (
    ("/about", "GET", about),  # addresses for other devices
    ("/browse", "GET", browse),  # folders of this machine: ?path=
    ("/scenes", "GET", scenes),
    ("/scenes", "POST", new),
)


@cache
def page_files() -> dict[str, Path]:
    """The files of the page, by name; "" is the page itself."""
    files = {path.name: path for path in (*_PAGES.iterdir(), THEME)}
    return {"": files["index.html"], **files}


def listing(path: Path) -> dict[str, Any]:
    """The folders in a folder of this machine, and how many photos, videos and zip files it has."""
    try:
        entries = sorted(path.iterdir(), key=lambda entry: entry.name.casefold())
    except (OSError, ValueError) as error:
        raise UserError(
            "{path}: {error}",
            path=printable(str(path)),
            error=cause_of(error),
        ) from None
    shown = [entry for entry in entries if not entry.name.startswith(".")]
    folders = [entry.name for entry in shown if is_folder(entry)]
    return {
        "path": str(path),
        "parent": str(path.parent),
        "folders": folders[:_FOLDERS],
        "files": [entry.name for entry in shown if entry.suffix.lower() in _FILES][:_FOLDERS],
        "photos": sum(entry.suffix.lower() in SUFFIXES for entry in shown),
    }


def is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:
        return False


def own_address() -> str | None:
    """The address of this machine in its network, for phones that do not know its name."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing
            return str(probe.getsockname()[0])
        except OSError:
            return None
