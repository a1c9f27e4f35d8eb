"""The formats in which a finished scene is handed on, and the command lines that do the same."""

from importlib.util import find_spec
from pathlib import Path

from snowsplat.pipeline.options.make import MakeOptions
from snowsplat.pipeline.options.scene import MeshOptions
from snowsplat.pipeline.options.video import VideoOptions
from snowsplat.project.page_film import PageFilm
from snowsplat.project.project import Project
from snowsplat.project.studio_scene import Job, StudioScene
from snowsplat.studio.library import safe_name
from snowsplat.util.flags import command_line, words
from snowsplat.util.safe_json import is_file

#: By kind: the end of the file's name.
FORMATS = {
    "ply": ".ply",
    "spz": ".spz",
    "sog": ".sog",
    "glb": ".glb",
    "usdz": ".usdz",
    "html": ".html",
    "zip": ".zip",
    "mesh": "_mesh.glb",
    "points": "_points.ply",
    "ar": "_ar.usdz",
}
#: Kinds that are made from the photos of a training, without the edits of the scene.
SURFACES = ("mesh", "points", "ar")
#: Of a mesh for phones, if the package that simplifies is installed.
_AR_TRIANGLES = 100_000


def formats_of(scene: StudioScene) -> list[str]:
    """The kinds of `FORMATS` that a scene can be written in."""
    missing = [] if find_spec("pxr") else ["usdz", "ar"]  # an optional package
    if Project.open(scene.made).training is None:
        missing += SURFACES
    return [kind for kind in FORMATS if kind not in missing]


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


def mesh_options(kind: str) -> MeshOptions:
    """How the surfaces of one of `SURFACES` are made."""
    if kind == "ar" and find_spec("fast_simplification"):
        return MeshOptions(triangles=_AR_TRIANGLES)
    return MeshOptions()


def export_command(scene: StudioScene, kind: str) -> str:
    """The command line that writes it."""
    file = scene.scene_file() or scene.made
    if kind == "zip":
        return command_line("publish", [file, "-o", "site"])
    if kind in SURFACES:
        options = words(MeshOptions, vars(mesh_options(kind)))
        verb = "points" if kind == "points" else "mesh"
        return command_line(verb, [scene.made, "-o", export_file(scene, kind).name], options)
    return command_line("convert", [file, export_file(scene, kind).name])


def film_command(scene: StudioScene, plan: PageFilm) -> str:
    """The command line that renders the film again."""
    settings = {"path": str(scene.keys), "seconds": plan.seconds, "size": plan.size}
    given = words(VideoOptions, {**settings, "ease": plan.ease})
    file = scene.scene_file() or scene.made
    return command_line("render", [file], given, ["--video", "film.mp4"])


def make_command(scene: StudioScene, job: Job) -> str:
    """The command line that makes the scene."""
    inputs = job.inputs or [str(scene.photos)]
    return command_line("make", inputs, ["-o", scene.made], words(MakeOptions, job.settings()))
