"""What changes a finished scene, or hands it on: edits, title, site, files in other formats.

Each of these is called by one process at a time, which holds `StudioScene.edit_lock`. If this
process is killed, the next call finishes what is left, or does all of it.
"""

import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from snowsplat.pipeline.convert import convert
from snowsplat.pipeline.edit import (
    OtherScene,
    edit,
    moved_film,
    page_frames,
    undo_edits,
    write_keys,
)
from snowsplat.pipeline.mesh import write_mesh
from snowsplat.pipeline.options.scene import PublishOptions
from snowsplat.pipeline.output.scene_source import load_trained
from snowsplat.pipeline.publish import PublishResult, publish
from snowsplat.project.edit_record import PageEdit, edited_file, remove_unfinished
from snowsplat.project.page_film import PageFilm
from snowsplat.project.project import Project
from snowsplat.project.site_folder import SiteFolder
from snowsplat.project.studio_scene import StudioScene
from snowsplat.studio.hand_on import SURFACES, export_file, is_exported, mesh_options
from snowsplat.studio.job import is_being_made
from snowsplat.studio.library import safe_title
from snowsplat.util.errors import UserError
from snowsplat.util.files import new_entries, remove_temporaries, write_json
from snowsplat.util.safe_json import from_json, is_file, read_json


def finished(scene: StudioScene) -> Path:
    """The scene file. Raises: UserError: the scene is not finished."""
    file = scene.scene_file()
    if file is None:
        raise UserError("the scene is not finished")
    return file


def export(scene: StudioScene, kind: str) -> dict[str, Any]:
    """Write the scene as a kind of `FORMATS`, unless that is done; returns the name of the file.

    Raises: UserError: the scene is not finished.
    """
    file, target = finished(scene), export_file(scene, kind)
    # It gets the time of the scene that is read, which may be replaced meanwhile.
    time = file.stat().st_mtime_ns
    if not is_exported(scene, kind):
        if kind == "zip" and not scene.is_shown():
            show_scene(scene)  # removes the other files
        target.parent.mkdir(exist_ok=True)
        if kind == "zip":
            with new_entries(target.parent, [target.name]) as new:
                shutil.make_archive(str(new / target.stem), "zip", scene.site)
        elif kind in SURFACES:
            write_mesh(
                lambda: load_trained(scene.made),
                target,
                mesh_options(kind),
                overwrite=True,
                points=kind == "points",
            )
        else:
            convert(file, target, overwrite=True)
        os.utime(target, ns=(time, time))
    return {"file": target.name}


@dataclass(frozen=True)
class _Begun:
    """What an edit changes beside the scene file, after it: what is done if its process is killed.

    Attributes:
        file: of the edited scene, in the folder of the scene.
        time: when this file was written before the edit, nanoseconds; 0: there was none. Only an
            edit that succeeds changes it, and no job or training does.
        title: the new one; "": as it is.
        plan: that of the film; its keys are in the world of the scene before all edits.
    """

    file: str
    time: int
    title: str
    plan: PageFilm | None


def _written_at(file: Path) -> int:
    return file.stat().st_mtime_ns if file.is_file() else 0


def edit_scene(scene: StudioScene, version: str) -> dict[str, Any]:
    """Write the edited scene and its page. ``version``: the scene that a page shows; "": any.

    Raises: UserError: the scene is not finished, is being made, or was changed since then.
    """
    return _edit(scene, version, scene.page_edit())


def undo_edit(scene: StudioScene, version: str) -> dict[str, Any]:
    """Remove the edited scene, and write the page of the other one. Raises: see `edit_scene`."""
    return _edit(scene, version, None)


def _edit(scene: StudioScene, version: str, changes: PageEdit | None) -> dict[str, Any]:
    if is_being_made(scene):
        raise UserError("the scene is being made; stop it, then edit it")
    scene.check_version(version)
    finish_edit(scene)  # an earlier one
    file, plan = finished(scene), None
    with suppress(OSError, ValueError):  # no film is planned
        plan = moved_film(scene.film_plan(), page_frames(file), [])
    title = changes.title and safe_title(changes.title) if changes else ""
    edited = edited_file(file)
    name = edited.relative_to(scene.folder).as_posix()
    write_json(scene.begun, asdict(_Begun(name, _written_at(edited), title, plan)))
    if changes is None:
        undo_edits(file)
    else:
        try:
            has_levels = SiteFolder(scene.site).scene() is None
            if has_levels:
                show_whole(scene)  # it is gone if the scene was renamed meanwhile
            edit(file, scene.whole if has_levels else scene.site, changes)
        except OtherScene as error:
            show_scene(scene)
            raise UserError("{error}. Open the page anew, then edit it", error=error) from None
    return show_scene(scene)


def finish_edit(scene: StudioScene) -> None:
    """Do what is left of an edit whose process was killed, if the scene was edited: the title is
    changed, and the keys of the film keep their places. Doing it again changes nothing."""
    remove_temporaries(scene.kept, [scene.begun.name])
    remove_unfinished(finished(scene))
    try:
        begun = from_json(_Begun, read_json(scene.begun))
    except (OSError, ValueError):  # nothing is left
        return
    if begun.time != _written_at(scene.folder / begun.file):
        if begun.title:
            scene.change(title=begun.title)
        if begun.plan is not None:
            file = finished(scene)
            plan = moved_film(begun.plan, [], page_frames(file))
            scene.write_film_plan(plan)
            if is_file(scene.keys):
                write_keys(file, plan, scene.keys)
    scene.begun.unlink()


def show_scene(scene: StudioScene, _: str = "") -> dict[str, Any]:
    """Write the site of a finished scene as it is now, and its figures.

    Raises: UserError: the scene is not finished.
    """
    finish_edit(scene)
    file, title = finished(scene), scene.job.title
    shown = [scene.version(), title]
    for folder in (scene.exports, scene.whole):  # they have another title, or other Gaussians
        shutil.rmtree(folder, ignore_errors=True)
    site = publish_site(scene, file, title)
    state = scene.state()
    if scene.found:
        state = {"outcome": "done", "result": _found(scene)}
    figures = {"gaussians": site.gaussians, "bytes": file.stat().st_size, "shown": shown}
    state["result"] |= figures
    scene.write_state(state)
    return {"file": file.name}


def publish_site(scene: StudioScene, file: Path, title: str) -> PublishResult:
    """Write the site. What else is in its folder is not of the studio, and is removed."""
    if SiteFolder(scene.site).content() is None:
        shutil.rmtree(scene.site, ignore_errors=True)
    return publish(file, scene.site, PublishOptions(title), overwrite=True)


def rename(scene: StudioScene, title: str) -> dict[str, Any]:
    """Change the title, also in the site if there is one."""
    if scene.scene_file() is None:
        scene.change(title=safe_title(title))
        return {}
    finish_edit(scene)  # which may have another title
    scene.change(title=safe_title(title))
    return show_scene(scene)


def show_whole(scene: StudioScene, _: str = "") -> dict[str, Any]:
    """Write the page that edits a scene whose site has levels of detail, unless it is there.

    Raises: UserError: the scene is not finished.
    """
    file, page = finished(scene), SiteFolder(scene.whole).page
    if not is_file(page) or page.stat().st_mtime_ns < file.stat().st_mtime_ns:
        options = PublishOptions(scene.job.title, for_editing=True)
        publish(file, scene.whole, options, overwrite=True)
    return {}


def _found(scene: StudioScene) -> dict[str, Any]:
    """What a scene of the command line tells about its training."""
    project = Project.open(scene.folder)
    folder = project.training_folder()
    facts = folder.read_metrics()  # empty: it was not evaluated, or not by this program
    aligned = bool(folder.exposures())
    psnr = facts.get("psnr_aligned" if aligned else "psnr")
    reports = {"training": folder.report, "photos": project.dataset.report}
    return {
        "psnr": psnr if facts.get("split") == "test" and isinstance(psnr, float) else None,
        "aligned": aligned,
        "seconds": None,
        "reports": existing_reports(scene, reports),
    }


def existing_reports(scene: StudioScene, reports: Mapping[str, Path | None]) -> dict[str, str]:
    """The paths of the reports that exist, in the output folder."""
    return {
        name: path.relative_to(scene.made).as_posix()
        for name, path in reports.items()
        if path is not None and path.is_relative_to(scene.made) and path.is_file()
    }
