"""`Library`: the folder of the studio, which has a folder for each scene.

A scene NAME has:

    NAME/job.json    its title, inputs and settings
    NAME/photos/     what was uploaded
    NAME/made/       the output folder of `snowsplat make`
    NAME/site/       the web site of the scene
    NAME/exports/    its files in other formats
    NAME/edit.json   what was changed in its page last
    NAME/state.json  the progress of the job, and its result
"""

from __future__ import annotations

import datetime
import json
import os
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from snowsplat.pipeline.output.edit_record import shown_file
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_json
from snowsplat.util.safe_json import from_json, printable, read_json

_JOB, _STATE = "job.json", "state.json"
_DEFAULT = "snowsplat_scenes"
_LONGEST = 80  # characters of a name
# Names that Windows reserves.
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)


class UnknownScene(UserError):
    """There is no scene of this name."""


@dataclass(frozen=True)
class Job:
    """What a scene is made of, and how.

    Attributes:
        title: its name, for people.
        created: UTC time, ISO 8601.
        inputs: files and folders of this machine; empty: those that were uploaded.
        quality: "draft", "normal" or "best"; None: not chosen.
        minutes: the time to finish within; None: as long as it takes.
    """

    title: str
    created: str
    inputs: list[str]
    quality: str | None = None
    minutes: float | None = None


class Scene:
    """A scene of the library; its files need not exist."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.photos = folder / "photos"
        self.made = folder / "made"
        self.site = folder / "site"
        self.exports = folder / "exports"
        self.edits = folder / "edit.json"
        self.lock = folder / ".job.lock"
        self.log = folder / "log.txt"

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def job(self) -> Job:
        """Raises UserError: its file is missing or damaged."""
        try:
            return from_json(Job, read_json(self.folder / _JOB))
        except (OSError, ValueError, KeyError, TypeError):
            raise UserError(f"{self.folder / _JOB}: damaged; make the scene again") from None

    def change(self, **changes: Any) -> Job:
        """Store changed fields of the job."""
        job = replace(self.job, **changes)
        write_json(self.folder / _JOB, asdict(job))
        return job

    def state(self) -> dict[str, Any]:
        """What the last process of the job has told; empty if there was none."""
        try:
            return dict(json.loads((self.folder / _STATE).read_text("utf-8")))
        except (OSError, ValueError, TypeError):
            return {}

    def write_state(self, state: dict[str, Any]) -> None:
        write_json(self.folder / _STATE, state)

    def inputs(self) -> list[Path]:
        """What the scene is made of, for `make`.

        Raises: UserError: nothing was uploaded.
        """
        given = self.job.inputs
        if given:
            return [Path(path) for path in given]
        entries = sorted(self.photos.iterdir()) if self.photos.is_dir() else []
        entries = [entry for entry in entries if not entry.name.startswith(".")]
        zips = [entry for entry in entries if entry.suffix.lower() == ".zip"]
        # The folders into which zip files were unpacked are no further inputs.
        unpacked = {name for entry in zips for name in (entry.stem, f"{entry.stem}_unpacked")}
        entries = [entry for entry in entries if not (entry.is_dir() and entry.name in unpacked)]
        if not entries:
            raise UserError("there are no photos yet; drop photos, a video or a zip file")
        return entries if len(entries) == 1 or zips else [self.photos]

    def scene_file(self) -> Path | None:
        """The finished scene, as it was edited."""
        result = self.state().get("result") or {}
        file = self.made / Path(str(result.get("file", ""))).name
        return shown_file(file) if file.is_file() else None


class Library:
    """The scenes in a folder, which is created. Raises OSError: it cannot be written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()
        self.folder.mkdir(parents=True, exist_ok=True)

    def scenes(self) -> list[Scene]:
        """All scenes, the newest first."""
        found = [Scene(file.parent) for file in self.folder.glob(f"*/{_JOB}")]
        return sorted(found, key=lambda scene: scene.folder.stat().st_ctime, reverse=True)

    def find(self, name: str) -> Scene:
        """Raises UnknownScene: there is none, or this is no name."""
        scene = Scene(self.folder / name)
        if safe_name(name) != name or not (scene.folder / _JOB).is_file():
            raise UnknownScene(f"{printable(name)}: there is no such scene")
        return scene

    def new(self, title: str, inputs: list[Path]) -> Scene:
        """A new scene with an own folder. Raises UserError: an input does not exist."""
        for path in inputs:
            try:
                os.stat(path)
            except (OSError, ValueError) as error:
                why = getattr(error, "strerror", None) or "no such file or folder"
                raise UserError(f"{printable(str(path))[:200]}: {why}") from None
        title = safe_title(title)
        name = safe_name(title)
        number = 1
        while True:
            scene = Scene(self.folder / (name if number == 1 else f"{name}-{number}"))
            try:
                scene.folder.mkdir(
                    mode=0o700
                )  # the state has the address of a page, with its token
                break
            except FileExistsError:
                number += 1
        now = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
        job = Job(title, now, [str(path.absolute()) for path in inputs])
        write_json(scene.folder / _JOB, asdict(job))
        return scene


def default_folder() -> Path:
    """Where scenes are kept if no folder is named: below the home folder, if there is one."""
    try:
        return Path.home() / _DEFAULT
    except RuntimeError:  # in containers, a user may have a number only
        return Path.cwd() / _DEFAULT


def safe_title(title: str) -> str:
    """A title of a scene: a short line without control characters."""
    return printable(" ".join(title.split()))[:_LONGEST] or "scene"


def safe_name(name: str) -> str:
    """A name of a file or folder that every system accepts, without a path: similar to ``name``."""
    name = re.sub(r'[\x00-\x1f\x7f<>:"/\\|?*\ud800-\udfff]', "_", name)
    name = name.lstrip(". ")
    stem, dot, suffix = name.rpartition(".")
    stem, suffix = (stem, suffix) if dot and len(suffix) <= 8 else (name, "")
    stem = stem[:_LONGEST]
    while len(stem.encode()) > 2 * _LONGEST:  # systems limit the bytes
        stem = stem[:-1]
    name = (f"{stem}.{suffix}" if suffix else stem).rstrip(". ") or "_"
    return f"_{name}" if _RESERVED.fullmatch(name) else name
