"""Requests about a scene: its state, uploads and job."""

import asyncio
import os
from dataclasses import asdict
from typing import Any
from urllib.parse import quote

from starlette.requests import Request

from snowsplat.evaluation.verdict import Verdict
from snowsplat.pipeline.options.make import MakeOptions
from snowsplat.project.project import Project
from snowsplat.project.studio_scene import StudioScene
from snowsplat.studio import job
from snowsplat.studio.given_photos import leave_out
from snowsplat.studio.hand_on import export_command, formats_of, make_command
from snowsplat.studio.library import safe_title
from snowsplat.studio.picture_requests import picture_of
from snowsplat.studio.requests import SceneRoutes, Studio, film_has_read, json_object, whole_number
from snowsplat.studio.texts import verdict_in_languages
from snowsplat.studio.uploads import Upload, uploads, write_part
from snowsplat.util.errors import UserError
from snowsplat.util.run_lock import is_locked
from snowsplat.util.safe_json import is_file
from snowsplat.viewer.http.guard import LOOK


async def details_of(studio: Studio, request: Request, scene: StudioScene) -> Any:
    # Reports are pages that others may have written: their address reads only reports.
    reports = f"scenes/{scene.name}/made/"
    told = await asyncio.to_thread(details, scene)
    return {**told, "made": f"../{request.scope[LOOK](reports)}/{quote(reports)}"}


async def remove(studio: Studio, request: Request, scene: StudioScene) -> Any:
    if job.is_being_made(scene) or job.is_running(scene, "film"):
        raise UserError("the scene or its film is being made; stop that, then remove it")
    async with studio.locks[scene.name, "edit"], studio.locks[scene.name, "upload"]:
        if is_locked(scene.edit_lock):
            raise UserError("the scene is being changed; remove it in a moment")
        photos = await asyncio.to_thread(scene.remove)
    return {"photos": None if photos is None else str(photos)}


async def open_scene(studio: Studio, request: Request, scene: StudioScene) -> Any:
    async with studio.locks[scene.name, "edit"]:
        if scene.is_shown():
            return {}
        return await asyncio.to_thread(job.work, scene, "show")


async def rename(studio: Studio, request: Request, scene: StudioScene) -> Any:
    title = (await json_object(request)).get("title")
    if not isinstance(title, str) or not title.strip():
        raise UserError("the title is empty; write one")
    if job.is_running(scene):
        raise UserError("the scene is being made; stop it, then rename it")
    async with studio.locks[scene.name, "edit"]:
        if safe_title(title) != scene.job.title:
            await asyncio.to_thread(job.work, scene, "rename", title=title)
    return {}


async def arrived(studio: Studio, request: Request, scene: StudioScene) -> Any:
    async with studio.locks[scene.name, "upload"]:
        return [asdict(file) for file in await asyncio.to_thread(uploads, scene)]


async def upload(studio: Studio, request: Request, scene: StudioScene) -> Any:
    query = request.query_params
    numbers = (whole_number(query.get(name)) for name in ("size", "modified", "start"))
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
    async with studio.locks[scene.name, "upload"]:
        studio.library.find(scene.name)  # it may have been removed meanwhile
        return {"received": await asyncio.to_thread(write_part, scene, file, data)}


async def survey(studio: Studio, request: Request, scene: StudioScene) -> Any:
    async with studio.locks["", "survey"]:
        return await asyncio.to_thread(job.work, scene, "survey")


async def marks(studio: Studio, request: Request, scene: StudioScene) -> Any:
    async with studio.locks["", "survey"]:
        return await asyncio.to_thread(job.work, scene, "marks")


async def change_given(studio: Studio, request: Request, scene: StudioScene) -> Any:
    wanted = await json_object(request)
    if job.is_running(scene):
        raise UserError("the scene is being made; stop it, then choose the photos")
    async with studio.locks[scene.name, "upload"]:
        name, out = str(wanted.get("name")), wanted.get("out") is True
        await asyncio.to_thread(leave_out, scene, name, out)
    return {}


async def start(studio: Studio, request: Request, scene: StudioScene) -> Any:
    wanted = await json_object(request)
    title = safe_title(str(wanted.get("title") or scene.job.title))
    given: dict[str, Any] = {name: wanted.get(name) for name in ("quality", "minutes")}
    MakeOptions(**given)  # says what is wrong
    scene.inputs()
    if studio.locks[scene.name, "edit"].locked():
        raise UserError("the scene is being changed or exported; start again in a moment")
    async with studio.locks[scene.name, "start"]:
        await film_has_read(scene)
        if not job.is_running(scene):
            scene.change(title=title, **given)
        job.start(scene)
    return {}


async def stop(studio: Studio, request: Request, scene: StudioScene) -> Any:
    job.stop(scene)
    return {}


ROUTES: SceneRoutes = (
    ("", "GET", details_of),  # its settings, progress and result
    ("", "DELETE", remove),
    ("/open", "POST", open_scene),  # writes the site of a scene of the command line
    ("/rename", "POST", rename),
    ("/uploads", "GET", arrived),  # what has arrived
    ("/uploads", "PUT", upload),  # adds a part
    ("/survey", "POST", survey),  # what the photos are, and how long it takes
    ("/marks", "POST", marks),  # which photos are blurred, damaged or doubles
    ("/given", "POST", change_given),  # leaves a photo out, or takes it back
    ("/start", "POST", start),
    ("/stop", "POST", stop),
)


def summary(scene: StudioScene) -> dict[str, Any]:
    """A scene in the list of all; one whose file is damaged does not hide the others."""
    try:
        about: dict[str, Any] = {"title": scene.job.title, "created": scene.job.created}
        about["picture"] = picture_of(scene) is not None
        status = status_of(scene, scene.state())
        about["status"] = "done" if status == "opening" else status
        verdict = verdict_on(scene, status)
        about["grade"] = verdict and verdict.grade
    except UserError:
        about = {"title": scene.name, "created": "", "status": "failed", "grade": None}
        about["picture"] = False
    return {"name": scene.name, **about}


def details(scene: StudioScene) -> dict[str, Any]:
    """A scene for its own page."""
    state, made = scene.state(), scene.job
    status = status_of(scene, state)
    verdict = verdict_on(scene, status)
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
        "status": status,
        "verdict": verdict and verdict_in_languages(verdict),
        "state": state,
        "has_page": has_page,
        "edited": edited_at(scene),
        "film": scene.film.stat().st_mtime if is_file(scene.film) else 0,
        "map": scene.map.stat().st_mtime if is_file(scene.map) else 0,
        "command": make_command(scene, made),
        "exports": {kind: export_command(scene, kind) for kind in formats_of(scene)},
    }


def status_of(scene: StudioScene, state: dict[str, Any]) -> str:
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


def verdict_on(scene: StudioScene, status: str) -> Verdict | None:
    """That on a finished scene; None if nothing was held out that could judge it."""
    if status not in ("done", "found", "opening"):
        return None
    return Verdict.from_json(Project.open(scene.made).verdict)


def edited_at(scene: StudioScene) -> float:
    """When the scene that is shown was edited, in seconds; 0 if it was not."""
    file = scene.scene_file()
    return file.stat().st_mtime if file and Project.open(file).edit else 0
