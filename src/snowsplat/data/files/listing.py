"""Lists the files of a folder, and tells from the names of folders what is in them."""

import logging
import os
import re
import unicodedata
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Literal

from snowsplat.util.errors import cause_of
from snowsplat.util.natural_order import natural_key

logger = logging.getLogger(__name__)

# What is in a folder of this name. The name is compared without regard to case, and without "_" and
# "." at its start and "_2", "_4" or "_8" at its end.
_MASKS = re.compile(r"mask|(\w+_)?masks|(dynamic|images?)_mask|mask_images?")
_OF_MAPS = r"(\w+_)?(mono_?)?{}s?(_?(maps?|images?|npy|aligned))?"
_DEPTHS, _NORMALS = (re.compile(_OF_MAPS.format(kind)) for kind in ("depth", "normal"))
_CONFIDENCES = re.compile("confidences?(_maps)?")
_THUMBNAILS = {"thumb", "thumbs", "thumbnail", "thumbnails", "@eadir", "__macosx"}
_DIVIDED = re.compile(r"(?P<original>.+)_[248]")
#: Names of folders that say that there are photos inside, and not which ones.
PHOTO_FOLDERS = frozenset(
    {
        "images",
        "image",
        "imgs",
        "img",
        "input",
        "photos",
        "photo",
        "pictures",
        "rgb",
        "color",
        "colors",
        "colour",
        "frames",
    }
)
# Names of folders that say that they hold changed copies of the photos in another one.
_CHANGED = re.compile(r"(corrected|undistorted|resized|downscaled)[_-](?P<original>.+)")
# More files than this are not listed, to bound memory and time: it may be a whole disk.
_MOST_FILES = 500_000

FolderKind = Literal["masks", "maps", "thumbnails", "photos"]


def folder_kind(name: str) -> FolderKind:
    """What the name of a folder says about the images inside; "photos" if it says nothing."""
    name = name.casefold().replace("-", "_").replace(" ", "_").lstrip("._")
    divided = _DIVIDED.fullmatch(name)
    name = divided["original"] if divided else name
    if _MASKS.fullmatch(name):
        return "masks"
    if any(names.fullmatch(name) for names in (_DEPTHS, _NORMALS, _CONFIDENCES)):
        return "maps"
    return "thumbnails" if name in _THUMBNAILS else "photos"


def folders_of_maps(root: Path) -> tuple[Path | None, Path | None]:
    """The folders of depth and of normal maps in a folder, by their usual names; the shortest."""
    names = sorted(root.iterdir(), key=lambda path: (len(path.name), path.name))
    folders = [path for path in names if path.is_dir()]
    depths, normals = (
        next((path for path in folders if kind.fullmatch(path.name.casefold())), None)
        for kind in (_DEPTHS, _NORMALS)
    )
    return depths, normals


def original_of(name: str, siblings: Iterable[str], *, divided: bool = True) -> str | None:
    """The folder beside ``name`` whose photos it holds undistorted or at another size, or None.

    ``corrected_images`` holds undistorted photos of ``images``; if ``divided``, then ``images_2``,
    ``images_4`` and ``images_8`` hold smaller ones.
    """
    name = name.casefold()
    match = _CHANGED.fullmatch(name) or (_DIVIDED.fullmatch(name) if divided else None)
    among = {sibling.casefold(): sibling for sibling in siblings}
    return None if match is None else among.get(match["original"])


def files_below(
    root: Path, enter: Callable[[Path, list[str]], Iterable[str]], broken: list[str] | None = None
) -> list[str]:
    """Files that are not hidden; relative to ``root``, with "/", in natural order.

    Links to folders are followed, but every folder is searched only once. Broken links, and folders
    that cannot be read, are left out; a warning names those. At most 500,000 files are listed.

    Args:
        enter: the subfolders of a folder to search, from the names of those that are not hidden.
        broken: gets the broken links.

    Raises: OSError: ``root`` cannot be read.
    """

    def fail(error: OSError) -> None:
        if Path(error.filename) == root:
            raise error
        logger.warning("%s: left out: %s", error.filename, cause_of(error))

    found: list[str] = []
    visited = {root.resolve()}
    for folder, subfolders, files in os.walk(root, followlinks=True, onerror=fail):
        here = Path(folder)
        kept = []
        for name in enter(here, sorted(name for name in subfolders if not name.startswith("."))):
            real = (here / name).resolve()
            if real not in visited:
                visited.add(real)
                kept.append(name)
        subfolders[:] = kept  # os.walk then searches only these
        for name in (name for name in files if not name.startswith(".")):
            path = here / name
            if path.is_file():
                found.append(path.relative_to(root).as_posix())
            elif broken is not None and path.is_symlink():
                broken.append(path.relative_to(root).as_posix())
        if len(found) > _MOST_FILES:
            break
    return sorted(found, key=natural_key)


def fold_name(name: str) -> str:
    """A name as it is compared: without regard to case and to the form of Unicode."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())
