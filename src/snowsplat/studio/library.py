"""`Library`: the folder of the studio, which has a folder for each scene; see `StudioScene`."""

import os
import re
from pathlib import Path

from snowsplat.project.studio_scene import StudioScene, is_studio_scene
from snowsplat.util.errors import UserError, cause_of
from snowsplat.util.safe_json import printable

_DEFAULT = "snowsplat_scenes"
_LONGEST = 80  # characters of a name
# Names that Windows reserves.
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)


class UnknownScene(UserError):
    """There is no scene of this name."""


class Library:
    """The scenes in a folder, which is created. Raises OSError: it cannot be written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()
        self.folder.mkdir(parents=True, exist_ok=True)

    def scenes(self) -> list[StudioScene]:
        """All scenes, the newest first."""
        folders = [each for each in self.folder.iterdir() if is_studio_scene(each)]
        found = [StudioScene(folder) for folder in folders]
        return sorted(found, key=lambda scene: scene.folder.stat().st_ctime, reverse=True)

    def find(self, name: str) -> StudioScene:
        """Raises UnknownScene: there is none, or this is no name."""
        folder = next((each for each in self.folder.iterdir() if each.name == name), None)
        if folder is None or not is_studio_scene(folder):
            raise UnknownScene("{name}: there is no such scene", name=printable(name))
        return StudioScene(folder)

    def new(self, title: str, inputs: list[Path]) -> StudioScene:
        """A new scene with an own folder. Raises UserError: an input does not exist."""
        for path in inputs:
            try:
                os.stat(path)
            except (OSError, ValueError) as error:
                why = cause_of(error)
                raise UserError("{path}: {why}", path=printable(str(path))[:200], why=why) from None
        title = safe_title(title)
        name = safe_name(title)
        number = 1
        while True:
            scene = StudioScene(self.folder / (name if number == 1 else f"{name}-{number}"))
            try:
                # The state has the address of a page, with its token.
                scene.folder.mkdir(mode=0o700)
                break
            except FileExistsError:
                number += 1
        scene.write_new_job(title, inputs)
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
