"""Finds the masks of photos, in each of the conventions that programs have.

For the photo ``images/sub/IMG.jpg``, these are masks:

- in a folder ``masks``, ``mask`` or the like, beside a folder on the way to the photo or in it
  (``masks/sub/``, ``images/masks/sub/``, ``images/sub/masks/`` …): ``IMG.jpg.png``, ``IMG.png``,
  ``IMG_mask.png``, ``IMG.mask.png``, ``IMG.jpg.mask.png`` and ``mask_IMG.png``;
- beside the photo: the names of these that are no name of a photo, and ``IMG.png``, if the file
  looks like a mask.

The format may be any of `decode.IMAGE_SUFFIXES`; letters may be in upper or lower case.
"""

import functools
import logging
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from snowsplat.data.dataset import PosedImage
from snowsplat.data.files.listing import (
    PHOTO_FOLDERS,
    files_below,
    fold_name,
    folder_kind,
    original_of,
)
from snowsplat.data.maps.mask_pixels import looks_like_mask
from snowsplat.data.photos.decode import is_photo

logger = logging.getLogger(__name__)

_MARKED_END = re.compile(r"(.+?)[._-]masks?")
_MARKED_START = re.compile(r"(?:dynamic_)?masks?[._-](.+)")


@dataclass
class FoundMasks:
    """The masks of photos.

    Attributes:
        of: photo -> mask file.
        unused: files that are masks, but of none of the photos.
        beside: names of the files among the photos that are masks of the others, or unused masks.
    """

    of: dict[str, Path] = field(default_factory=dict)
    unused: list[Path] = field(default_factory=list)
    beside: set[str] = field(default_factory=set)


def find_masks(root: Path, photos: Sequence[str]) -> FoundMasks:
    """The masks of photos below a folder, or beside it if it is called "images" or the like.

    ``photos``: all image files outside of folders of masks, relative to ``root`` with "/". Some may
    turn out to be masks.

    Raises: OSError: a folder cannot be read.
    """
    found = FoundMasks()
    by_folder: dict[str, list[str]] = {}
    for photo in photos:
        by_folder.setdefault(_parent(photo), []).append(photo)
    for names in by_folder.values():
        _find_beside(root, names, found)
    left = [photo for photo in photos if photo not in found.beside]
    listed: set[Path] = set()
    for folder in sorted(_ancestors(by_folder), key=lambda f: (-f.count("/"), not f, f)):
        above = f"{folder}/" if folder else ""
        for masks in _mask_folders(root / folder):
            inside = {p: p[len(above) :] for p in left if p.startswith(above)}
            listed |= _find_in(masks, inside, found)
    # In ``input``, a dataset keeps its original photos; masks beside it are those of other images.
    if root.name.casefold() in PHOTO_FOLDERS - {"input"}:
        for masks in _mask_folders(root.parent):
            listed |= _find_in(masks, {photo: f"{root.name}/{photo}" for photo in left}, found)
    found.unused += sorted(listed - set(found.of.values()))
    return found


def _find_beside(root: Path, names: Sequence[str], found: FoundMasks) -> None:
    """Masks in the folder of the photos; ``names``: all images of that folder."""
    by_base: dict[str, list[str]] = {}  # the photos that a mask without further words may mean
    for name in names:
        for base in _bases_of_photo(PurePosixPath(name).name):
            by_base.setdefault(base, []).append(name)
    look = functools.cache(lambda name: looks_like_mask(root / name))
    for name in names:
        stem, *marked = _bases_of_mask(PurePosixPath(name).name)
        meant = [p for base in marked for p in by_base.get(base, []) if p != name]
        # IMG.png beside IMG.jpg may be the same photo.
        alike = [p for p in by_base.get(stem, []) if p != name and look(name) and not look(p)]
        if alike or (marked and look(name)):
            found.beside.add(name)
            found.of |= {photo: root / name for photo in [*meant, *alike] if photo not in found.of}
            if not meant and not alike:
                found.unused.append(root / name)
    for mask in found.beside & found.of.keys():  # IMG.png and IMG_mask.png, both masks of IMG.jpg
        del found.of[mask]


def _find_in(folder: Path, photos: dict[str, str], found: FoundMasks) -> set[Path]:
    """Masks in a folder of masks: all of its files. Adds to ``found`` those of photos without one.

    ``photos``: photo -> its path relative to the parent of ``folder``.
    """
    masks = list(filter(is_photo, files_below(folder, lambda _, subfolders: subfolders)))
    by_key: dict[tuple[str, str], Path] = {}  # folder and base; a name without words comes first
    for rank in range(3):
        for file in masks:
            bases = list(_bases_of_mask(PurePosixPath(file).name))
            if rank < len(bases):
                key = fold_name(_parent(file)), bases[rank]
                by_key.setdefault(key, folder / file)
    open_photos = {p: r for p, r in photos.items() if p not in found.of}
    deepest = max((relative.count("/") for relative in open_photos.values()), default=0)
    for level in range(deepest + 1):  # leave out the first folders of the path of the photo
        hits: dict[str, Path] = {}
        folders_of: dict[Path, set[str]] = {}
        for photo, relative in open_photos.items():
            parts = relative.split("/")
            if level >= len(parts):
                continue
            parent = fold_name("/".join(parts[level:-1]))
            mask = next(
                (m for base in _bases_of_photo(parts[-1]) if (m := by_key.get((parent, base)))),
                None,
            )
            if mask is not None:
                hits[photo] = mask
                folders_of.setdefault(mask, set()).add(_parent(photo))
        # A mask of photos in several folders is of no use: whose it is cannot be known.
        found.of |= {p: mask for p, mask in hits.items() if len(folders_of[mask]) == 1}
        open_photos = {p: r for p, r in open_photos.items() if p not in hits}
    return {folder / file for file in masks}


def _bases_of_photo(name: str) -> tuple[str, str]:
    """What the masks of a photo are called after: IMG.jpg, then IMG."""
    return fold_name(name), fold_name(PurePosixPath(name).stem)


def _bases_of_mask(name: str) -> Iterator[str]:
    """What a mask is called after: its name without suffix, then also without the word "mask"."""
    base = fold_name(PurePosixPath(name).stem)
    yield base
    for pattern in (_MARKED_END, _MARKED_START):
        if marked := pattern.fullmatch(base):
            yield marked[1]


def _mask_folders(parent: Path) -> list[Path]:
    with os.scandir(parent) as entries:
        names = sorted(e.name for e in entries if folder_kind(e.name) == "masks" and e.is_dir())
    return [parent / name for name in names if original_of(name, names) is None]


def _ancestors(folders: Iterable[str]) -> set[str]:
    """The folders and all folders above them, up to "" (the root)."""
    found = {""}
    for folder in folders:
        while folder and folder not in found:
            found.add(folder)
            folder = _parent(folder)
    return found


def _parent(path: str) -> str:
    return path.rpartition("/")[0]


def is_marked(path: str) -> bool:
    """Whether a name says that the file is a mask: IMG_mask.png, mask_IMG.png …"""
    return len(list(_bases_of_mask(PurePosixPath(path).name))) > 1


def with_masks(root: Path, posed: Sequence[PosedImage]) -> list[PosedImage]:
    """The images, with the masks that `find_masks` finds for those that have none.

    Logs a line if there are masks of no image in the folders of the images.

    ``root``: the folder of the dataset.
    """
    posed = list(posed)
    for base in dict.fromkeys(_base(root, image) for image in posed):
        here = [image for image in posed if _base(root, image) == base]
        names = {image.path.relative_to(base).as_posix(): image for image in here}
        folders = {name.rpartition("/")[0] for name in names}
        try:
            # All photos of these folders: a mask of a photo without a pose is not misspelt.
            beside = [f"{f}/{name}".lstrip("/") for f in folders for name in _images_in(base / f)]
            found = find_masks(base, sorted({*names, *beside}))
        except OSError:  # a folder that may not be read
            continue
        masks = {names[name]: mask for name, mask in found.of.items() if name in names}
        posed = [
            replace(image, mask=masks[image]) if image.mask is None and image in masks else image
            for image in posed
        ]
        named = {image.mask.resolve() for image in posed if image.mask is not None}
        unused = [mask for mask in found.unused if mask.resolve() not in named]
        if unused:
            logger.warning(
                "%s: %d masks are not used, because no photo has the name of %s; the mask of "
                "IMG.jpg is masks/IMG.png, IMG.jpg.png or IMG_mask.png",
                root,
                len(unused),
                unused[0],
            )
    return posed


def _base(root: Path, image: PosedImage) -> Path:
    return root if image.folder.is_relative_to(root) else image.folder


def _images_in(folder: Path) -> list[str]:
    with os.scandir(folder) as entries:
        return [e.name for e in entries if not e.name.startswith(".") and is_photo(e.name)]
