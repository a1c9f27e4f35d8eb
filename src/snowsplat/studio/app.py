"""`studio_app`: the requests of the page of the studio.

    GET  /                            the page, and its modules
    GET  /about                       addresses for other devices
    GET  /browse?path=                folders of this machine
    GET  /scenes                      all scenes; POST makes a new one
    GET  /scenes/NAME                 a scene: its settings, progress and result; DELETE removes it
    GET  /scenes/NAME/picture         a small picture of it
    POST /scenes/NAME/open, /rename   writes the site of a scene of the command line; its title
    GET  /scenes/NAME/uploads         what has arrived; PUT adds a part
    POST /scenes/NAME/survey          what the photos are, and how long it takes
    POST /scenes/NAME/start, /stop    its job
    GET  /scenes/NAME/photos          its photos, and which have a pose; /photos/N is a small one
    GET  /scenes/NAME/map             the cameras and points from above
    POST /scenes/NAME/exports/KIND    writes a file; GET sends it
    GET  /scenes/NAME/film            its film; POST renders one, DELETE stops that
    POST /scenes/NAME/film/path       the path of a film
    GET  /scenes/NAME/film/file       the film
    POST /scenes/NAME/edit            stores what was changed in the viewer; DELETE takes it back
    GET  /scenes/NAME/site/…, /made/… the scene in the viewer, its reports
    POST /scenes/NAME/whole           the page that edits a scene with levels; GET /whole/…
    GET  /scenes/NAME/live/…          the page of the running training, with its WebSocket

Answers are JSON; an error is ``{"error": …}``, one line for people.
"""

from __future__ import annotations

import asyncio
import io
import math
import os
import socket
from collections import defaultdict
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import segno
from PIL import Image, ImageOps
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

from snowsplat.project.edit_record import PageEdit
from snowsplat.project.page_film import PageFilm
from snowsplat.project.project import Project
from snowsplat.project.studio_scene import StudioScene
from snowsplat.studio import job
from snowsplat.studio.hand_on import (
    FORMATS,
    export_command,
    export_file,
    film_command,
    is_exported,
    make_command,
)
from snowsplat.studio.library import Library, UnknownScene, safe_name, safe_title
from snowsplat.studio.relay import relay_file, relay_socket
from snowsplat.studio.uploads import NoSpace, Upload, WrongPart, uploads, write_part
from snowsplat.util.errors import UserError, message_of
from snowsplat.util.run_lock import is_locked
from snowsplat.util.safe_json import from_json, is_file, printable
from snowsplat.util.theme import THEME
from snowsplat.viewer.http.served_file import FileOnDisk, content_type
from snowsplat.viewer.http.static import send_file

_PAGES = Path(__file__).parent / "pages"
_QUALITIES = ("draft", "normal", "best")
_LONGEST_MINUTES = 7 * 24 * 60
_PHOTOS = 120  # of which small pictures are shown
_SMALL = 320  # pixels of their longer side
_FOLDERS = 500  # that are listed
_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".heic", ".tif", ".tiff", ".mp4", ".mov", ".zip")
#: The content security policy of the page.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "media-src 'self'; connect-src 'self'; frame-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
# The site has the rest of its policy in its page.
_SITE_POLICY = "frame-ancestors 'self'"
_REPORT_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src 'self' data:; frame-ancestors 'self'"
)

# The page of a scene gets tools: a film, and editing. They come before the script of the page,
# which looks for them. Levels of detail are edited in a page of their own, with all Gaussians.
_TOOLS = (
    '<link rel="stylesheet" href="../../../theme.css" />'
    '<link rel="stylesheet" href="../../../tools.css" />'
    '<script src="../../../chinese.js"></script><script src="../../../told.js"></script>'
    '<script type="module" src="../../../tools.js" data-page="{page}" data-edited="{edited}" '
    'data-version="{version}"></script>'
)

_Answer = Callable[[Request, StudioScene], Awaitable[Any]]


def studio_app(library: Library, addresses: Callable[[], list[str]]) -> Starlette:
    """The app. ``addresses``: the URLs of the page for other machines."""
    app = Starlette(routes=_Studio(library, addresses).routes())
    app.router.redirect_slashes = False  # the address would lack the token
    return app


class _File:
    """A response with a file, and further headers."""

    def __init__(self, path: Path, **headers: str) -> None:
        self._path, self._headers = path, headers

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        file = FileOnDisk(self._path, content_type(self._path)) if is_file(self._path) else None
        await send_file(file, scope, receive, send, self._headers)


class _Studio:
    def __init__(self, library: Library, addresses: Callable[[], list[str]]) -> None:
        self._library, self._addresses = library, addresses
        # By scene ("": all) and kind of work: a second request waits for the first one.
        self._locks: dict[tuple[str, str], asyncio.Lock] = defaultdict(asyncio.Lock)

    def routes(self) -> list[BaseRoute]:
        page = [Route(f"/{name}", self._page) for name in _page_files()]
        scene = [
            ("", "GET", self._scene),
            ("", "DELETE", self._remove),
            ("/picture", "GET", self._picture),
            ("/open", "POST", self._open),
            ("/rename", "POST", self._rename),
            ("/uploads", "GET", self._uploads),
            ("/uploads", "PUT", self._upload),
            ("/survey", "POST", self._survey),
            ("/start", "POST", self._start),
            ("/stop", "POST", self._stop),
            ("/photos", "GET", self._photos),
            ("/photos/{number:int}", "GET", self._photo),
            ("/map", "GET", self._map),
            ("/exports/{kind}", "POST", self._export),
            ("/exports/{kind}", "GET", self._exported),
            ("/film", "GET", self._film),
            ("/film", "POST", self._render_film),
            ("/film", "DELETE", self._stop_film),
            ("/film/path", "POST", self._film_path),
            ("/film/file", "GET", self._film_file),
            ("/edit", "POST", self._edit),
            ("/edit", "DELETE", self._undo),
            ("/site/{path:path}", "GET", self._site),
            ("/whole", "POST", self._write_whole),
            ("/whole/{path:path}", "GET", self._whole),
            ("/made/{path:path}", "GET", self._made),
            ("/live/{path:path}", "GET", self._live),
        ]
        return [
            *page,
            WebSocketRoute("/scenes/{name}/live/live", self._live_images),
            Route("/about", _answering(self._about)),
            Route("/browse", _answering(self._browse)),
            Route("/scenes", _answering(self._scenes), methods=["GET"]),
            Route("/scenes", _answering(self._new), methods=["POST"]),
            *(
                Route(f"/scenes/{{name}}{path}", _answering(self._of(answer)), methods=[method])
                for path, method, answer in scene
            ),
        ]

    def _of(self, answer: _Answer) -> Callable[[Request], Awaitable[Any]]:
        async def find(request: Request) -> Any:
            return await answer(request, self._library.find(request.path_params["name"]))

        return find

    async def _page(self, request: Request) -> Any:
        return _File(_page_files()[request.url.path.strip("/")])

    async def _about(self, request: Request) -> Any:
        path = request.query_params.get("path", "")
        urls = [f"{url}{path}" for url in self._addresses()]
        codes = [segno.make(url, error="m").svg_data_uri(scale=4, border=2) for url in urls]
        return {
            "folder": str(self._library.folder),
            "addresses": [{"url": u, "code": c} for u, c in zip(urls, codes, strict=True)],
        }

    async def _browse(self, request: Request) -> Any:
        path = request.query_params.get("path") or str(self._library.folder.parent)
        return _listing(Path(os.path.expanduser(path)))

    async def _scenes(self, request: Request) -> Any:
        # A lock of another computer takes seconds to judge.
        scenes = self._library.scenes()
        return await asyncio.to_thread(lambda: [_summary(scene) for scene in scenes])

    async def _new(self, request: Request) -> Any:
        wanted = await _object(request)
        path = str(wanted.get("path") or "").strip()
        inputs = [Path(os.path.expanduser(path))] if path else []
        if inputs and not inputs[0].is_absolute():
            raise UserError(
                "{path}: write the whole path, such as /home/me/photos", path=printable(path)
            )
        names = [path.name if _is_folder(path) else path.stem for path in inputs]
        title = str(wanted.get("title") or "".join(names))
        return {"name": self._library.new(title, inputs).name}

    async def _scene(self, request: Request, scene: StudioScene) -> Any:
        return await asyncio.to_thread(_details, scene)

    async def _remove(self, request: Request, scene: StudioScene) -> Any:
        if job.is_being_made(scene) or job.is_running(scene, "film"):
            raise UserError("the scene or its film is being made; stop that, then remove it")
        async with self._locks[scene.name, "edit"], self._locks[scene.name, "upload"]:
            if is_locked(scene.edit_lock):
                raise UserError("the scene is being changed; remove it in a moment")
            photos = await asyncio.to_thread(scene.remove)
        return {"photos": None if photos is None else str(photos)}

    async def _picture(self, request: Request, scene: StudioScene) -> Any:
        picture = await asyncio.to_thread(_picture_of, scene)
        if picture is None:
            raise UnknownScene("there is no picture yet")
        return Response(await asyncio.to_thread(_small, picture), media_type="image/jpeg")

    async def _open(self, request: Request, scene: StudioScene) -> Any:
        async with self._locks[scene.name, "edit"]:
            if scene.is_shown():
                return {}
            return await asyncio.to_thread(job.work, "show", scene.folder)

    async def _rename(self, request: Request, scene: StudioScene) -> Any:
        title = (await _object(request)).get("title")
        if not isinstance(title, str) or not title.strip():
            raise UserError("the title is empty; write one")
        if job.is_running(scene):
            raise UserError("the scene is being made; stop it, then rename it")
        async with self._locks[scene.name, "edit"]:
            if safe_title(title) != scene.job.title:
                await asyncio.to_thread(job.work, "rename", scene.folder, title)
        return {}

    async def _uploads(self, request: Request, scene: StudioScene) -> Any:
        async with self._locks[scene.name, "upload"]:
            return [asdict(file) for file in await asyncio.to_thread(uploads, scene)]

    async def _upload(self, request: Request, scene: StudioScene) -> Any:
        query = request.query_params
        numbers = (_whole(query.get(name)) for name in ("size", "modified", "start"))
        file = Upload(query.get("path", ""), *numbers)
        if job.is_running(scene):
            raise UserError("the scene is being made; stop it, then add photos")
        if scene.found:
            scene.inputs()  # says why not
        if scene.job.inputs:
            raise UserError(
                "the scene is made from {inputs}; add the photos there", inputs=scene.job.inputs[0]
            )
        data = await request.body()
        async with self._locks[scene.name, "upload"]:
            self._library.find(scene.name)  # it may have been removed meanwhile
            return {"received": await asyncio.to_thread(write_part, scene, file, data)}

    async def _survey(self, request: Request, scene: StudioScene) -> Any:
        async with self._locks["", "survey"]:
            return await asyncio.to_thread(job.work, "survey", scene.folder)

    async def _start(self, request: Request, scene: StudioScene) -> Any:
        wanted = await _object(request)
        quality, minutes = wanted.get("quality"), wanted.get("minutes")
        if quality is not None and quality not in _QUALITIES:
            raise UserError("quality: choose from {qualities}", qualities=", ".join(_QUALITIES))
        if minutes is not None and not (
            isinstance(minutes, int | float)
            and math.isfinite(minutes)
            and 0 < minutes <= _LONGEST_MINUTES
        ):
            raise UserError(
                "minutes: use a number above 0, at most {longest_minutes}",
                longest_minutes=_LONGEST_MINUTES,
            )
        scene.inputs()
        if self._locks[scene.name, "edit"].locked():
            raise UserError("the scene is being changed or exported; start again in a moment")
        async with self._locks[scene.name, "start"]:
            await _film_has_read(scene)
            if not job.is_running(scene):
                title = safe_title(str(wanted.get("title") or scene.job.title))
                scene.change(title=title, quality=quality, minutes=minutes)
            job.start(scene)
        return {}

    async def _stop(self, request: Request, scene: StudioScene) -> Any:
        job.stop(scene)
        return {}

    async def _photos(self, request: Request, scene: StudioScene) -> Any:
        return await asyncio.to_thread(_photo_list, scene)

    async def _photo(self, request: Request, scene: StudioScene) -> Any:
        shown = await asyncio.to_thread(_shown_photos, scene)
        number = request.path_params["number"]
        if number >= len(shown):
            raise UnknownScene("there is no such photo")
        return Response(await asyncio.to_thread(_small, shown[number]), media_type="image/jpeg")

    async def _map(self, request: Request, scene: StudioScene) -> Any:
        return _File(scene.map)

    async def _export(self, request: Request, scene: StudioScene) -> Any:
        kind = _kind(request)
        async with self._locks["", "export"], self._locks[scene.name, "edit"]:
            if is_exported(scene, kind):  # needs no process, and no folder that can be written
                return {"file": export_file(scene, kind).name}
            return await asyncio.to_thread(job.work, "export", scene.folder, kind)

    async def _exported(self, request: Request, scene: StudioScene) -> Any:
        file = export_file(scene, _kind(request))
        name = f"attachment; filename*=UTF-8''{quote(file.name)}"
        return _File(file, **{"Content-Disposition": name})

    async def _film(self, request: Request, scene: StudioScene) -> Any:
        state = scene.state("film")
        try:
            plan = scene.film_plan()
        except (OSError, ValueError):  # there is none
            plan = None
        return {
            "running": job.is_running(scene, "film"),
            "plan": plan and asdict(plan),
            "now": state.get("now"),
            "outcome": state.get("outcome"),
            "error": state.get("error"),
            "bytes": scene.film.stat().st_size if is_file(scene.film) else 0,
            "command": plan and film_command(scene, plan),
        }

    async def _render_film(self, request: Request, scene: StudioScene) -> Any:
        plan = await _planned(request)
        async with self._locks[scene.name, "edit"], self._locks[scene.name, "film"]:
            scene.check_version(_version(request))
            if not job.is_running(scene, "film"):
                scene.write_film_plan(plan)
                scene.write_state({}, "film")
            job.start(scene, "film")
        return {}

    async def _stop_film(self, request: Request, scene: StudioScene) -> Any:
        job.stop(scene, "film")
        return {}

    async def _film_path(self, request: Request, scene: StudioScene) -> Any:
        plan = await _planned(request)
        async with self._locks[scene.name, "edit"], self._locks[scene.name, "film"]:
            scene.check_version(_version(request))
            if job.is_running(scene, "film"):
                raise UserError("a film is being rendered; wait until it ends, or stop it")
            scene.write_film_plan(plan)
            return await asyncio.to_thread(job.work, "preview", scene.folder)

    async def _film_file(self, request: Request, scene: StudioScene) -> Any:
        name = f"inline; filename*=UTF-8''{quote(safe_name(scene.job.title))}.mp4"
        return _File(scene.film, **{"Content-Disposition": name})

    async def _edit(self, request: Request, scene: StudioScene) -> Any:
        try:
            changes = from_json(PageEdit, await _object(request))
        except ValueError as error:
            raise UserError("this cannot be stored: {error}", error=error) from None
        async with self._locks[scene.name, "edit"]:
            await _film_has_read(scene)
            scene.write_page_edit(changes)
            return await asyncio.to_thread(job.work, "edit", scene.folder, _version(request))

    async def _undo(self, request: Request, scene: StudioScene) -> Any:
        async with self._locks[scene.name, "edit"]:
            await _film_has_read(scene)
            return await asyncio.to_thread(job.work, "undo", scene.folder, _version(request))

    async def _site(self, request: Request, scene: StudioScene) -> Any:
        kind = "small" if (scene.site / "scene.sog").is_file() else "levels"
        return await self._with_tools(request, scene, scene.site, kind)

    async def _write_whole(self, request: Request, scene: StudioScene) -> Any:
        async with self._locks[scene.name, "edit"]:
            return await asyncio.to_thread(job.work, "whole", scene.folder)

    async def _whole(self, request: Request, scene: StudioScene) -> Any:
        return await self._with_tools(request, scene, scene.whole, "whole")

    async def _with_tools(self, request: Request, scene: StudioScene, site: Path, kind: str) -> Any:
        path = request.path_params["path"] or "index.html"
        file = _inside(site, path)
        if path == "index.html" and is_file(file):
            page = await asyncio.to_thread(file.read_text, "utf-8")
            edited = str(bool(_edited(scene))).lower()
            # A page that is not yet that of the scene cannot change it.
            version = (scene.state().get("result") or {}).get("shown", ["-"])[0]
            head = _TOOLS.format(page=kind, edited=edited, version=version)
            text = page.replace("</head>", f"{head}</head>", 1)
            return HTMLResponse(text, headers={"Content-Security-Policy": _SITE_POLICY})
        return _File(file, **{"Content-Security-Policy": _SITE_POLICY})

    async def _made(self, request: Request, scene: StudioScene) -> Any:
        file = _inside(scene.made, request.path_params["path"])
        return _File(file, **{"Content-Security-Policy": _REPORT_POLICY})

    async def _live(self, request: Request, scene: StudioScene) -> Any:
        page = scene.state().get("page")
        if page is None:
            raise UnknownScene("no training runs")
        return await relay_file(page, quote(request.path_params["path"]))

    async def _live_images(self, socket: WebSocket) -> None:
        try:
            page = self._library.find(socket.path_params["name"]).state().get("page")
        except UnknownScene:
            page = None
        if page is None:
            await socket.accept()  # a refusal would be an error in the console
            await socket.close()
        else:
            await relay_socket(socket, page)


def _answering(answer: Callable[[Request], Awaitable[Any]]) -> Callable[[Request], Awaitable[Any]]:
    """An endpoint: what ``answer`` returns as JSON, or its error."""

    async def endpoint(request: Request) -> Any:
        try:
            value = await answer(request)
            fresh = {"Cache-Control": "no-store"}
            return value if callable(value) else JSONResponse(value, headers=fresh)
        except WrongPart as error:
            return JSONResponse({"error": str(error), "received": error.received}, 409)
        except UserError as error:
            codes = {UnknownScene: 404, NoSpace: 507}
            return JSONResponse({"error": str(error)}, codes.get(type(error), 400))
        except OSError as error:
            return JSONResponse({"error": printable(str(message_of(error)))}, 500)

    return endpoint


@cache
def _page_files() -> dict[str, Path]:
    """The files of the page, by name; "" is the page itself."""
    files = {path.name: path for path in (*_PAGES.iterdir(), THEME)}
    return {"": files["index.html"], **files}


def _summary(scene: StudioScene) -> dict[str, Any]:
    """A scene in the list of all; one whose file is damaged does not hide the others."""
    try:
        about = {"title": scene.job.title, "created": scene.job.created}
        status = _status(scene, scene.state())
        about["status"] = "done" if status == "opening" else status
    except UserError:
        about = {"title": scene.name, "created": "", "status": "failed"}
    return {"name": scene.name, "picture": _picture_of(scene) is not None, **about}


def _details(scene: StudioScene) -> dict[str, Any]:
    """A scene for its own page."""
    state, made = scene.state(), scene.job
    has_page = state.pop("page", None) is not None  # its address is a secret of the job
    state.pop("placed", None)  # `_photos` tells it
    return {
        "name": scene.name,
        "title": made.title,
        "folder": str(scene.folder),
        "found": scene.found,
        "inputs": made.inputs,
        "quality": made.quality,
        "minutes": made.minutes,
        "status": _status(scene, state),
        "state": state,
        "has_page": has_page,
        "edited": _edited(scene),
        "film": scene.film.stat().st_mtime if is_file(scene.film) else 0,
        "map": scene.map.stat().st_mtime if is_file(scene.map) else 0,
        "command": make_command(scene, made),
        "exports": {kind: export_command(scene, kind) for kind in FORMATS},
    }


def _status(scene: StudioScene, state: dict[str, Any]) -> str:
    """One of new, running, done, stopped, failed or, if the process was killed, interrupted.

    A scene of the command line is "found" until its site was written; any other one is "opening"
    if the process that has changed it was killed before it has written the site. In a folder that
    cannot be written, the site remains as it is.
    """
    if scene.found:
        return "done" if scene.is_shown() else "found"
    if job.is_running(scene):
        return "running"
    if not state and scene.job.quality is None and scene.job.minutes is None:
        return "new"
    status = str(state.get("outcome", "interrupted"))
    behind = status == "done" and not scene.is_shown() and not is_locked(scene.edit_lock)
    return "opening" if behind and os.access(scene.kept, os.W_OK) else status


def _edited(scene: StudioScene) -> float:
    """When the scene that is shown was edited, in seconds; 0 if it was not."""
    file = scene.scene_file()
    return file.stat().st_mtime if file and Project.open(file).edit else 0


def _version(request: Request) -> str:
    """That of the scene which the page shows."""
    return request.query_params.get("version", "")


async def _film_has_read(scene: StudioScene) -> None:
    """Wait until a film that has started has read the scene: it shows the scene as it was then."""
    while job.is_running(scene, "film") and "now" not in scene.state("film"):
        await asyncio.sleep(0.1)


async def _planned(request: Request) -> PageFilm:
    try:
        return from_json(PageFilm, await _object(request))
    except ValueError as error:
        raise UserError("no such film is possible: {error}", error=error) from None


async def _object(request: Request) -> dict[str, Any]:
    try:
        wanted = await request.json()
    except (ValueError, RecursionError):
        wanted = None
    if not isinstance(wanted, dict):
        raise UserError("the request is no JSON object")
    return wanted


def _whole(text: str | None) -> int:
    if text is None or not (text.isascii() and text.isdecimal()) or len(text) > 18:
        raise UserError("size, modified and start are whole numbers")
    return int(text)


def _kind(request: Request) -> str:
    kind = str(request.path_params["kind"])
    if kind not in FORMATS:
        raise UnknownScene("the formats are {formats}", formats=", ".join(FORMATS))
    return kind


def _inside(folder: Path, path: str) -> Path:
    """A file in a folder. Raises UnknownScene: the path leads elsewhere."""
    try:
        file = (folder / path).resolve()
        inside = file.is_relative_to(folder.resolve())
    except (OSError, ValueError):
        inside = False
    if not inside:
        raise UnknownScene("there is no such file")
    return file


def _listing(path: Path) -> dict[str, Any]:
    """The folders in a folder of this machine, and how many photos, videos and zip files it has."""
    try:
        entries = sorted(path.iterdir(), key=lambda entry: entry.name.casefold())
    except (OSError, ValueError) as error:
        raise UserError(
            "{path}: {getattr}",
            path=printable(str(path)),
            getattr=getattr(error, "strerror", None) or "no such folder",
        ) from None
    shown = [entry for entry in entries if not entry.name.startswith(".")]
    folders = [entry.name for entry in shown if _is_folder(entry)]
    return {
        "path": str(path),
        "parent": str(path.parent),
        "folders": folders[:_FOLDERS],
        "files": [e.name for e in shown if e.suffix.lower() in (".mp4", ".mov", ".zip")][:_FOLDERS],
        "photos": sum(entry.suffix.lower() in _SUFFIXES for entry in shown),
    }


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:
        return False


def _photo_list(scene: StudioScene) -> list[dict[str, Any]]:
    """The names of the photos that are shown, and whether they have a pose so far."""
    shown, placed = _shown_photos(scene), scene.state().get("placed")
    if placed is None:
        return [{"name": path.name, "placed": True} for path in shown]
    names, folder = set(placed), Project.open(scene.made).dataset.photos
    inside = ((path.name, path.relative_to(folder).as_posix()) for path in shown)
    return [{"name": name, "placed": path in names} for name, path in inside]


def _shown_photos(scene: StudioScene) -> list[Path]:
    """The photos of the dataset: those with a pose as soon as they are known, before that all."""
    dataset = Project.open(scene.made).dataset
    # While poses are estimated, the images of an earlier job may still be there.
    early = "placed" in scene.state()
    for folder in (dataset.photos,) if early else (dataset.images, dataset.photos):
        if folder.is_dir():
            found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES)
            step = max(1, math.ceil(len(found) / _PHOTOS))
            return found[::step]
    return []


def _picture_of(scene: StudioScene) -> Path | None:
    """Of the site; before that a rendered test view, or a photo."""
    poster = scene.site / "poster.jpg"
    if is_file(poster):
        return poster
    training = Project.open(scene.made).training
    views = training.rendered_views() if training else []
    return next(iter([*views[:1], *_shown_photos(scene)[:1]]), None)


def _small(path: Path) -> bytes:
    """A small picture as a JPEG file. Raises UserError: the file is no photo."""
    try:
        with Image.open(path) as photo:
            photo.draft("RGB", (2 * _SMALL, 2 * _SMALL))  # faster JPEG decoding
            small = ImageOps.exif_transpose(photo)
            small.thumbnail((_SMALL, _SMALL))
            file = io.BytesIO()
            small.convert("RGB").save(file, "JPEG", quality=80)
            return file.getvalue()
    except (OSError, ValueError, SyntaxError):
        raise UserError("{name}: cannot be shown", name=printable(path.name)) from None


def own_address() -> str | None:
    """The address of this machine in its network, for phones that do not know its name."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing
            return str(probe.getsockname()[0])
        except OSError:
            return None
