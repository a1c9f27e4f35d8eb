"""The photos that were given for a scene, before its job, and those that are left out."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from snowsplat.data.photos.suffixes import PHOTO_SUFFIXES
from snowsplat.project.studio_scene import StudioScene
from snowsplat.studio.library import UnknownScene
from snowsplat.util.errors import UserError
from snowsplat.util.natural_order import natural_key
from snowsplat.util.safe_json import inside, is_file

_MOST = 2000  # photos that are listed


@dataclass(frozen=True)
class GivenPhoto:
    """A photo that was given.

    Attributes:
        name: relative to the upload or to the input, with "/".
        out: whether the user has left it out.
    """

    name: str
    path: Path
    out: bool


def given_photos(scene: StudioScene) -> list[GivenPhoto]:
    """The photos in natural order of their names; empty if nothing was given."""
    found = [photo for root, out in _roots(scene) for photo in _photos_in(root, out)]
    return sorted(found, key=lambda photo: natural_key(photo.name))[:_MOST]


def find_given(scene: StudioScene, name: str) -> GivenPhoto:
    """The photo of a name, which is used or left out; no folder is listed.

    Raises: UnknownScene: there is none.
    """
    for root, out in _roots(scene):
        path = root if root.name == name and root.is_file() else inside(root, name)
        if path and path.suffix.lower() in PHOTO_SUFFIXES and is_file(path):
            return GivenPhoto(name, path, out)
    raise UnknownScene("there is no such photo")


def first_given(scene: StudioScene) -> Path | None:
    """A photo that is used. It is found soon, however many photos the folder of a user has."""
    used = (photo for root, out in _roots(scene) if not out for photo in _photos_in(root, out))
    return next((photo.path for photo in used), None)


def leave_out(scene: StudioScene, name: str, out: bool) -> None:
    """Move an uploaded photo away from those that the scene is made of, or back.

    Raises:
        UserError: the photos are in a folder of the user.
        UnknownScene: there is no such photo, or it is there already.
    """
    if scene.job.inputs:
        raise UserError(
            "the photos are in {inputs}; remove the photo there", inputs=scene.job.inputs[0]
        )
    found = find_given(scene, name)
    target = (scene.left_out if out else scene.photos) / name
    if found.out == out or target.exists():
        raise UnknownScene("there is no such photo")
    target.parent.mkdir(parents=True, exist_ok=True)
    os.replace(found.path, target)


def _roots(scene: StudioScene) -> Iterator[tuple[Path, bool]]:
    """The photos and folders that were given, and whether the user has left out what is there."""
    if not scene.found:
        for root in [Path(path) for path in scene.job.inputs] or [scene.photos]:
            yield root, False
    yield scene.left_out, True


def _photos_in(root: Path, out: bool) -> Iterator[GivenPhoto]:
    if root.suffix.lower() in PHOTO_SUFFIXES and root.is_file():
        yield GivenPhoto(root.name, root, out)
    for folder, folders, names in os.walk(root):
        folders[:] = sorted(each for each in folders if not each.startswith("."))
        for name in sorted(names):
            path = Path(folder) / name
            if path.suffix.lower() in PHOTO_SUFFIXES and not name.startswith("."):
                yield GivenPhoto(path.relative_to(root).as_posix(), path, out)
