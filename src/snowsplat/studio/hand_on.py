"""The formats in which a finished scene is handed on, and the command lines that do the same."""

from __future__ import annotations

import shlex
from pathlib import Path

from snowsplat.project.page_film import PageFilm
from snowsplat.project.studio_scene import Job, StudioScene
from snowsplat.studio.library import safe_name
from snowsplat.util.safe_json import is_file

#: By kind: the end of the file's name.
FORMATS = {
    "ply": ".ply",
    "spz": ".spz",
    "sog": ".sog",
    "glb": ".glb",
    "html": ".html",
    "zip": ".zip",
}


def export_file(scene: StudioScene, kind: str) -> Path:
    """The file of a scene in one of `FORMATS`; it need not exist."""
    return scene.exports / (safe_name(scene.job.title) + FORMATS[kind])


def is_exported(scene: StudioScene, kind: str) -> bool:
    """Whether this file has the scene as it is now: `export` gives it the time of the scene."""
    file, target = scene.scene_file(), export_file(scene, kind)
    return (
        file is not None
        and is_file(target)
        and target.stat().st_mtime_ns == file.stat().st_mtime_ns
    )


def export_command(scene: StudioScene, kind: str) -> str:
    """The command line that writes it."""
    file = scene.scene_file() or scene.made
    if kind == "zip":
        return shlex.join(["snowsplat", "publish", str(file), "-o", "site"])
    return shlex.join(["snowsplat", "convert", str(file), export_file(scene, kind).name])


def film_command(scene: StudioScene, plan: PageFilm) -> str:
    """The command line that renders the film again."""
    words = ["snowsplat", "render", str(scene.scene_file() or scene.made), "--path"]
    words += [str(scene.keys), "--seconds", f"{plan.seconds:g}", "--size", plan.size]
    return shlex.join([*words, *["--ease"] * plan.ease, "--video", "film.mp4"])


def make_command(scene: StudioScene, job: Job) -> str:
    """The command line that makes the scene."""
    inputs = job.inputs or [str(scene.photos)]
    words = ["snowsplat", "make", *inputs, "-o", str(scene.made)]
    words += ["--quality", job.quality] if job.quality else []
    words += ["--minutes", f"{job.minutes:g}"] if job.minutes else []
    return shlex.join(words)
