"""Requests about a finished scene: files, films, edits, and its pages."""

import asyncio
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from starlette.requests import Request
from starlette.responses import HTMLResponse
from starlette.websockets import WebSocket

from snowsplat.project.edit_record import PageEdit
from snowsplat.project.page_film import PageFilm
from snowsplat.project.site_folder import PAGE, SiteFolder
from snowsplat.project.studio_scene import StudioScene
from snowsplat.studio import job
from snowsplat.studio.hand_on import FORMATS, export_file, film_command, is_exported
from snowsplat.studio.library import UnknownScene, safe_name
from snowsplat.studio.relay import relay_socket
from snowsplat.studio.requests import (
    Data,
    File,
    SceneRoutes,
    Studio,
    file_inside,
    film_has_read,
    json_object,
    version_of_page,
)
from snowsplat.studio.scene_requests import edited_at
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import from_json, is_file
from snowsplat.viewer.hosts import LOCAL_HOST
from snowsplat.viewer.http.guard import LOOK
from snowsplat.viewer.live.page_files import FILES, INDEX, POLICY
from snowsplat.viewer.web.viewer_page import asset_file, content_policy, page_anew

# A report has no origin, so it cannot reach the studio; and its address has no secret of it.
_REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'"
)

# The page of a scene gets tools: a film, and editing. They come before the script of the page,
# which looks for them. Levels of detail are edited in a page of their own, with all Gaussians.
_TOOLS = (
    '<link rel="stylesheet" href="../../../theme.css" />'
    '<link rel="stylesheet" href="../../../tools.css" />'
    '<script type="module" src="../../../tools.js" data-page="{page}" data-edited="{edited}" '
    'data-version="{version}"></script>'
)


async def export(studio: Studio, request: Request, scene: StudioScene) -> Any:
    kind = kind_of(request)
    async with studio.locks["", "export"], studio.locks[scene.name, "edit"]:
        if is_exported(scene, kind):  # needs no process, and no folder that can be written
            return {"file": export_file(scene, kind).name}
        return await asyncio.to_thread(job.work, scene, "export", kind=kind)


async def exported(studio: Studio, request: Request, scene: StudioScene) -> Any:
    file = export_file(scene, kind_of(request))
    name = f"attachment; filename*=UTF-8''{quote(file.name)}"
    return Data(file, **{"Content-Disposition": name})


async def film(studio: Studio, request: Request, scene: StudioScene) -> Any:
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


async def render_film(studio: Studio, request: Request, scene: StudioScene) -> Any:
    plan = await planned_film(request)
    async with studio.locks[scene.name, "edit"], studio.locks[scene.name, "film"]:
        scene.check_version(version_of_page(request))
        if not job.is_running(scene, "film"):
            scene.write_film_plan(plan)
            scene.write_state({}, "film")
        job.start(scene, "film")
    return {}


async def stop_film(studio: Studio, request: Request, scene: StudioScene) -> Any:
    job.stop(scene, "film")
    return {}


async def film_path(studio: Studio, request: Request, scene: StudioScene) -> Any:
    plan = await planned_film(request)
    async with studio.locks[scene.name, "edit"], studio.locks[scene.name, "film"]:
        scene.check_version(version_of_page(request))
        if job.is_running(scene, "film"):
            raise UserError("a film is being rendered; wait until it ends, or stop it")
        scene.write_film_plan(plan)
        return await asyncio.to_thread(job.work, scene, "preview")


async def film_file(studio: Studio, request: Request, scene: StudioScene) -> Any:
    name = f"inline; filename*=UTF-8''{quote(safe_name(scene.job.title))}.mp4"
    return Data(scene.film, **{"Content-Disposition": name})


async def edit(studio: Studio, request: Request, scene: StudioScene) -> Any:
    try:
        changes = from_json(PageEdit, await json_object(request))
    except ValueError as error:
        raise UserError("this cannot be stored: {error}", error=error) from None
    async with studio.locks[scene.name, "edit"]:
        await film_has_read(scene)
        scene.write_page_edit(changes)
        return await asyncio.to_thread(job.work, scene, "edit", version=version_of_page(request))


async def undo(studio: Studio, request: Request, scene: StudioScene) -> Any:
    async with studio.locks[scene.name, "edit"]:
        await film_has_read(scene)
        return await asyncio.to_thread(job.work, scene, "undo", version=version_of_page(request))


async def site(studio: Studio, request: Request, scene: StudioScene) -> Any:
    kind = "small" if SiteFolder(scene.site).scene() else "levels"
    return await with_tools(request, scene, scene.site, kind)


async def write_whole(studio: Studio, request: Request, scene: StudioScene) -> Any:
    async with studio.locks[scene.name, "edit"]:
        return await asyncio.to_thread(job.work, scene, "whole")


async def whole(studio: Studio, request: Request, scene: StudioScene) -> Any:
    return await with_tools(request, scene, scene.whole, "whole")


async def with_tools(request: Request, scene: StudioScene, site: Path, kind: str) -> Any:
    path = request.path_params["path"] or PAGE
    file = file_inside(site, path)
    if path in ("index.css", "index.js"):
        return File(asset_file(path))
    if path != PAGE or not is_file(file):
        return Data(file)
    try:
        page = page_anew(await asyncio.to_thread(file.read_text, "utf-8"))
    except ValueError:
        raise UnknownScene("the page of the scene is damaged") from None
    policy = content_policy(page, "'self'") + "; frame-ancestors 'self'"
    if request.scope[LOOK] is not None:
        # A page that is not yet that of the scene cannot change it.
        shown = scene.shown_version() or "-"
        edited = str(bool(edited_at(scene))).lower()
        head = _TOOLS.format(page=kind, edited=edited, version=escape(shown))
        page = page.replace("</head>", f"{head}</head>", 1)
    return HTMLResponse(page, headers={"Content-Security-Policy": policy})


async def made(studio: Studio, request: Request, scene: StudioScene) -> Any:
    file = file_inside(scene.made, request.path_params["path"])
    if request.scope[LOOK] is not None or file.suffix != ".html":
        raise UnknownScene("there is no such file")
    return File(file, **{"Content-Security-Policy": _REPORT_POLICY})


async def live(studio: Studio, request: Request, scene: StudioScene) -> Any:
    file = FILES.get(request.path_params["path"] or INDEX)
    if file is None:
        raise UnknownScene("there is no such file")
    return File(file, **{"Content-Security-Policy": POLICY})


async def live_images(studio: Studio, socket: WebSocket) -> None:
    try:
        scene = studio.library.find(socket.path_params["name"])
        # The folder of a stranger could name any page.
        page = scene.state().get("page") if await asyncio.to_thread(job.is_running, scene) else None
    except UnknownScene:
        page = None
    if urlsplit(str(page)).hostname != LOCAL_HOST:
        page = None
    if page is None:
        await socket.accept()  # a refusal would be an error in the console
        await socket.close()
    else:
        await relay_socket(socket, page)


ROUTES: SceneRoutes = (
    ("/exports/{kind}", "POST", export),  # writes a file
    ("/exports/{kind}", "GET", exported),  # sends it
    ("/film", "GET", film),
    ("/film", "POST", render_film),
    ("/film", "DELETE", stop_film),
    ("/film/path", "POST", film_path),  # the path of a film
    ("/film/file", "GET", film_file),
    ("/edit", "POST", edit),  # stores what was changed in the viewer
    ("/edit", "DELETE", undo),  # takes it back
    ("/site/{path:path}", "GET", site),  # the scene in the viewer
    ("/whole", "POST", write_whole),  # the page that edits a scene with levels
    ("/whole/{path:path}", "GET", whole),
    ("/made/{path:path}", "GET", made),  # its reports
    ("/live/{path:path}", "GET", live),  # the page of the running training
)


async def planned_film(request: Request) -> PageFilm:
    try:
        return from_json(PageFilm, await json_object(request))
    except ValueError as error:
        raise UserError("no such film is possible: {error}", error=error) from None


def kind_of(request: Request) -> str:
    kind = str(request.path_params["kind"])
    if kind not in FORMATS:
        raise UnknownScene("the formats are {formats}", formats=", ".join(FORMATS))
    return kind
