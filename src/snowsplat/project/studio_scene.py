"""`StudioScene`: the files of a scene of the studio, which has a folder of its own.

    NAME/job.json    its title, inputs and settings
    NAME/photos/     what was uploaded
    NAME/made/       the output folder of `snowsplat make`
    NAME/site/       the web site of the scene
    NAME/whole/      a page for editing, if the site has levels of detail
    NAME/exports/    its files in other formats
    NAME/edit.json   what was changed in its page last; edit_begun.json: what is left to do after it
    NAME/film.json   the plan of its film; film_cameras.json and film.mp4 are the film
    NAME/state.json  the progress of the job, and its result; film_state.json: of the film

An output folder of the command line is a scene, too. What the studio adds to it is in its folder
`studio/`.
"""

import datetime
import json
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from snowsplat.project.edit_record import PageEdit, shown_file
from snowsplat.project.page_film import PageFilm
from snowsplat.project.project import Project
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_json
from snowsplat.util.safe_json import from_json, read_json

_JOB = "job.json"
#: The ending of an upload that is not complete.
PART = ".part"
#: What a process of its own does for a scene, and the files of its state, lock and output.
TASKS = {
    "make": ("state.json", ".job.lock", "log.txt"),
    "film": ("film_state.json", ".film.lock", "film_log.txt"),
}
_STUDIO = "studio"  # in output folders of the command line


@dataclass(frozen=True)
class Job:
    """What a scene is made of, and how.

    Attributes:
        title: its name, for people.
        created: UTC time, ISO 8601.
        inputs: files and folders of this machine; empty: those that were uploaded.
        quality: "draft", "normal" or "best"; None: not chosen.
        minutes: the time to finish within; None: as long as it takes.
        example: whether the photos are those of the demo; the job makes them.
    """

    title: str
    created: str
    inputs: list[str]
    quality: str | None = None
    minutes: float | None = None
    example: bool = False

    def settings(self) -> dict[str, Any]:
        """Those of `make` that are set: name -> value, see `MakeOptions`."""
        given = {"quality": self.quality, "minutes": self.minutes, "title": self.title}
        return {name: value for name, value in given.items() if value is not None}


class StudioScene:
    """A scene of the library; its files need not exist.

    Attributes:
        folder: that of the scene.
        found: whether ``folder`` is an output folder of the command line.
        kept: the folder of the studio's own files.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.found = not (folder / _JOB).is_file() and _has_scene(folder)
        self.kept = kept = folder / _STUDIO if self.found else folder
        self.made = folder if self.found else folder / "made"
        self.photos = kept / "photos"
        self.left_out = kept / "left_out"  # uploaded photos that the user does not want
        self.site = kept / "site"
        self.whole = kept / "whole"
        self.exports = kept / "exports"
        self.edits = kept / "edit.json"
        self.begun = kept / "edit_begun.json"
        self.map = kept / "map.svg"
        self.plan = kept / "film.json"
        self.keys = kept / "film_cameras.json"
        self.film = kept / "film.mp4"

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def job(self) -> Job:
        """Raises UserError: its file is missing or damaged."""
        file = self.kept / _JOB
        if self.found and not file.is_file():
            project = Project.open(self.folder)
            made = datetime.datetime.fromtimestamp(
                project.scene_file().stat().st_mtime, datetime.timezone.utc
            )
            return Job(project.name, made.isoformat(timespec="seconds"), [])
        try:
            return from_json(Job, read_json(file))
        except (OSError, ValueError, KeyError, TypeError):
            raise UserError("{file}: damaged; make the scene again", file=file) from None

    def write_new_job(self, title: str, inputs: Sequence[Path]) -> None:
        """Store the job of a new scene, whose folder is there."""
        now = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
        job = Job(title, now, [str(path.absolute()) for path in inputs])
        write_json(self.folder / _JOB, asdict(job))

    def change(self, **changes: Any) -> Job:
        """Store changed fields of the job."""
        job = replace(self.job, **changes)
        self.kept.mkdir(exist_ok=True, mode=0o700)
        write_json(self.kept / _JOB, asdict(job))
        return job

    def film_plan(self) -> PageFilm:
        """The plan of its film. Raises OSError, ValueError: there is none."""
        return from_json(PageFilm, read_json(self.plan))

    def write_film_plan(self, plan: PageFilm) -> None:
        write_json(self.plan, asdict(plan))

    def page_edit(self) -> PageEdit:
        """What was changed in its page last. Raises OSError, ValueError: nothing was."""
        return from_json(PageEdit, read_json(self.edits))

    def write_page_edit(self, changes: PageEdit) -> None:
        write_json(self.edits, asdict(changes))

    def lock(self, task: str = "make") -> Path:
        return self.kept / TASKS[task][1]

    @property
    def edit_lock(self) -> Path:
        """Held by the process that changes the scene, its site or its exports."""
        return self.kept / ".edit.lock"

    def log(self, task: str = "make") -> Path:
        return self.kept / TASKS[task][2]

    def state(self, task: str = "make") -> dict[str, Any]:
        """What the last process of a task has told; empty if there was none."""
        try:
            return dict(json.loads((self.kept / TASKS[task][0]).read_text("utf-8")))
        except (OSError, ValueError, TypeError):
            return {}

    def write_state(self, state: dict[str, Any], task: str = "make") -> None:
        write_json(self.kept / TASKS[task][0], state)

    def inputs(self) -> list[Path]:
        """What the scene is made of, for `make`.

        Raises: UserError: nothing was uploaded, or the command line has made the scene.
        """
        if self.found:
            raise UserError("{folder}: made in a terminal; continue it there", folder=self.folder)
        given = self.job.inputs
        if given:
            return [Path(path) for path in given]
        if self.job.example:
            return [self.photos]
        entries = sorted(self.photos.iterdir()) if self.photos.is_dir() else []
        entries = [e for e in entries if not (e.name.startswith(".") or e.name.endswith(PART))]
        zips = [entry for entry in entries if entry.suffix.lower() == ".zip"]
        # The folders into which zip files were unpacked are no further inputs.
        unpacked = {name for entry in zips for name in (entry.stem, f"{entry.stem}_unpacked")}
        entries = [entry for entry in entries if not (entry.is_dir() and entry.name in unpacked)]
        if not entries:
            raise UserError("there are no photos yet; drop photos, a video or a zip file")
        return entries if len(entries) == 1 or zips else [self.photos]

    def scene_file(self) -> Path | None:
        """The finished scene, as it was edited."""
        if self.found:
            return shown_file(Project.open(self.folder).scene_file())
        result = self.state().get("result") or {}
        file = self.made / Path(str(result.get("file", ""))).name
        return shown_file(file) if file.is_file() else None

    def version(self) -> str:
        """Names the content of the scene file; "" if there is none."""
        file = self.scene_file()
        return version_of(file) if file else ""

    def check_version(self, version: str) -> None:
        """Raises UserError: a page shows another version, whose world is another one. "" is any."""
        if version not in ("", self.version()):
            raise UserError("the scene was changed in another page; open this page anew")

    def is_shown(self) -> bool:
        """Whether the site shows what `scene_file` is now, under its title.

        A training in a terminal may have gone on since the site was written, or the process that
        has edited the scene was killed before it wrote the site.
        """
        return self._shown() == [self.version(), self.job.title]

    def shown_version(self) -> str:
        """The version of the scene that the site shows; "" if none is known."""
        shown = self._shown()
        return str(shown[0]) if shown else ""

    def _shown(self) -> list[Any]:
        result = self.state().get("result")
        shown = result.get("shown") if isinstance(result, dict) else None
        return shown if isinstance(shown, list) else []

    def remove(self) -> Path | None:
        """Remove the scene, but not its photos; returns their folder, or None if it has none.

        Raises:
            UserError: the command line has made it.
            OSError: a file cannot be removed.
        """
        if self.found or self.folder.is_symlink():
            raise UserError(
                "{folder}: made in a terminal; it may have other files, so remove it there",
                folder=self.folder,
            )
        # The job is last: until then, the scene is listed and can be removed again.
        for folder in (self.made, self.site, self.whole, self.exports):
            if folder.is_symlink():
                folder.unlink()
            elif folder.exists():
                shutil.rmtree(folder)
        files = [self.edits, self.begun, self.map, self.plan, self.keys, self.film, self.edit_lock]
        files += [self.folder / name for names in TASKS.values() for name in names]
        for file in (*files, self.folder / _JOB):
            file.unlink(missing_ok=True)
        for folder in (self.left_out, self.photos, self.folder):
            with suppress(OSError):  # there are photos, or other files
                folder.rmdir()
        return self.photos if self.photos.exists() else None


def is_studio_scene(folder: Path) -> bool:
    """Whether it belongs to the library: it has a job, or a scene of the command line."""
    try:
        return (folder / _JOB).is_file() or _has_scene(folder)
    except OSError:  # it cannot be read
        return False


def _has_scene(folder: Path) -> bool:
    project = Project.open(folder)
    if project.is_file or project.scene is None or project.training is None:
        return False
    return bool(project.made) or project.training.is_training()


def version_of(file: Path) -> str:
    """Names the content of a scene file; each training and each edit changes it."""
    return str(file.stat().st_mtime_ns)
