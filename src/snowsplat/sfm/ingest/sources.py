"""Finds the input files: photos and videos, their names in ``input/``, and their masks."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from snowsplat.data.image_file import OPTIONAL_FORMATS
from snowsplat.sfm.ingest.archive import files_in, is_zip, other_archive, unpack
from snowsplat.sfm.ingest.clip import ONLY_SOUND, why_no_video
from snowsplat.sfm.ingest.photo_or_film import photos_or_films
from snowsplat.sfm.ingest.unread_formats import (
    UNREAD_SUFFIXES,
    format_name,
    unread_photos,
)
from snowsplat.util.errors import UserError
from snowsplat.util.files import shown


def _suffixes(names: str) -> frozenset[str]:
    return frozenset(f".{name}" for name in names.split())


PHOTO_SUFFIXES = _suffixes(
    "jpg jpeg jpe jfif mpo png webp tif tiff heic heif hif bmp ppm "
    + " ".join(OPTIONAL_FORMATS).lower()
)
VIDEO_SUFFIXES = _suffixes(
    "mp4 mov m4v mkv avi webm mpg mpeg mts m2ts ts 3gp 3g2 wmv ogv mjpeg flv insv gif"
)
MASKS = "masks"
#: The record of the stages of a dataset, and its name in version 0.1.0.
RECORDS = ("sfm.json", "capture.json")
# Folders that contain one of these files are datasets or output folders. They are skipped.
_OUTPUT_FILES = (*RECORDS, "cfg_args")


@dataclass(frozen=True)
class Source:
    """An input file."""

    path: Path
    kind: Literal["photo", "video"]
    #: Relative to ``input/``, with "/": the file of a photo, or the folder for the frames of a
    #: video ("" for ``input/`` itself).
    name: str
    mask: Path | None = None  # the mask of a photo


@dataclass(frozen=True)
class Sources:
    """The photos and videos in the inputs, as `find_sources` has found them.

    Attributes:
        inputs: the files and folders that were searched.
        files: in the order of the inputs; files of a folder are sorted by name.
        left_out: path and reason of each photo or video that is not used.
        unused_masks: masks without a photo.
    """

    inputs: tuple[Path, ...]
    files: list[Source]
    left_out: list[tuple[str, str]]
    unused_masks: list[Path]

    @property
    def photos(self) -> list[Source]:
        return [source for source in self.files if source.kind == "photo"]

    @property
    def videos(self) -> list[Source]:
        return [source for source in self.files if source.kind == "video"]

    @property
    def paths(self) -> list[Path]:
        """All files that structure from motion reads, including masks."""
        paths = (path for source in self.files for path in (source.path, source.mask))
        return [path for path in paths if path is not None]

    def contain(self, folder: Path) -> bool:
        """Whether ``folder`` itself is one of the inputs."""
        return any(path.resolve() == folder.resolve() for path in self.inputs)


def find_sources(inputs: Sequence[Path]) -> Sources:
    """Find photos and videos in files and folders; folders are searched recursively.

    Hidden files, ``masks`` folders, datasets and output folders are skipped. Videos in a folder
    with photos are also skipped, because some phones save a video of three seconds with every
    photo. A zip file is unpacked into a folder beside it. If there is a single input, the files
    keep their names. If there are several, each input folder and each video gets its own folder in
    ``input/``, so that equal names do not collide.

    Raises:
        UserError: an input does not exist, or is neither a photo nor a video; or no file was found.
    """
    if not inputs:
        raise UserError("inputs: none given; add a folder of photos, photos or a video")
    files: list[Source] = []
    left_out: list[tuple[str, str]] = []
    unused: list[Path] = []
    seen: dict[Path, Path] = {}
    folders = {MASKS}  # names in use

    def add(source: Source) -> None:
        real = source.path.resolve()
        if real in seen:
            left_out.append((shown(source.path), f"is the same file as {shown(seen[real])}"))
        else:
            seen[real] = source.path
            files.append(source)

    for path in inputs:
        if not path.exists():
            raise UserError(f"{shown(path)}: no such file or folder")
        if is_zip(path):
            path = _unpacked(path)
        if not path.is_dir():
            kind = kind_of_file(path)
            if kind == "photo":
                add(Source(path, kind, shown(path.name), Masks(path.parent).mask_of(path.name)))
            else:
                add(Source(path, kind, "" if len(inputs) == 1 else _free(path.stem, folders)))
            continue
        photos, videos = _scan(path)
        if unread := unread_photos(_files_below(path), photos):
            left_out.append((shown(path), unread))
        chosen = photos_or_films(path, photos, videos)
        photos, videos = chosen.photos, chosen.videos
        left_out += [(shown(path / relative), reason) for relative, reason in chosen.left_out]
        prefix = "" if len(inputs) == 1 else _free(path.resolve().name, folders)
        masks = Masks(path)
        for relative in photos:
            name = str(PurePosixPath(prefix) / shown(relative))
            add(Source(path / relative, "photo", name, masks.mask_of(relative)))
        unused += masks.unused
        for relative in videos:
            stem = str(PurePosixPath(prefix) / PurePosixPath(relative).with_suffix(""))
            only = len(videos) == 1
            add(Source(path / relative, "video", prefix if only else _free(stem, folders)))
    if not files:
        raise _nothing_in(inputs)
    return Sources(tuple(inputs), files, left_out, unused)


def _scan(root: Path) -> tuple[list[str], list[str]]:
    """Photos and videos below a folder, by their extensions; relative with "/", sorted."""
    photos, videos = [], []
    for relative in _files_below(root):
        suffix = PurePosixPath(relative).suffix.lower()
        if suffix in PHOTO_SUFFIXES:
            photos.append(relative)
        elif suffix in VIDEO_SUFFIXES:
            videos.append(relative)
    return photos, videos


def _files_below(root: Path, leave_out: Sequence[str] = (MASKS,)) -> list[str]:
    """Files that are not hidden; relative to ``root``, with "/", sorted.

    Links to folders are followed, but every folder is searched only once. Folders named as in
    ``leave_out``, datasets and output folders are skipped.
    """

    def fail(error: OSError) -> None:
        raise error

    found = []
    visited = {root.resolve()}
    for folder, subfolders, files in os.walk(root, followlinks=True, onerror=fail):
        here = Path(folder)
        kept = []
        for name in sorted(subfolders):
            real = (here / name).resolve()
            is_output = any((here / name / file).is_file() for file in _OUTPUT_FILES)
            if not (name.startswith(".") or name in leave_out or is_output or real in visited):
                visited.add(real)
                kept.append(name)
        subfolders[:] = kept  # os.walk then searches only these
        found += [
            (here / name).relative_to(root).as_posix()
            for name in files
            if not name.startswith(".") and (here / name).is_file()
        ]
    return sorted(found)


class Masks:
    """The masks of a folder of photos: ``masks/IMG.jpg.png`` or ``masks/IMG.png`` for ``IMG.jpg``.

    The mask of ``sub/IMG.jpg`` is in ``masks/sub/`` or in ``sub/masks/``. All image formats are
    accepted; the extension may be in upper or lower case.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._by_folder: dict[Path, dict[str, Path]] = {}
        self._used: set[Path] = set()

    def mask_of(self, relative: str) -> Path | None:
        """The mask of a photo whose path is relative to the root, or None."""
        name = PurePosixPath(relative)
        for folder, key in (
            (self._root / MASKS, relative),
            ((self._root / relative).parent / MASKS, name.name),
        ):
            listed = self._listed(folder)
            mask = listed.get(key) or listed.get(str(PurePosixPath(key).with_suffix("")))
            if mask is not None:
                self._used.add(mask)
                return mask
        return None

    @property
    def unused(self) -> list[Path]:
        """Masks without a photo; their names are probably misspelt."""
        there = {path for listed in self._by_folder.values() for path in listed.values()}
        return sorted(there - self._used)

    def _listed(self, folder: Path) -> dict[str, Path]:
        """Paths of the masks in a folder, by their names without extension."""
        if folder not in self._by_folder:
            files = _files_below(folder, ()) if folder.is_dir() else []
            self._by_folder[folder] = {
                str(PurePosixPath(file).with_suffix("")): folder / file
                for file in files
                if PurePosixPath(file).suffix.lower() in PHOTO_SUFFIXES
            }
        return self._by_folder[folder]


def _unpacked(path: Path) -> Path:
    """The folder of a zip file of photos or videos. Raises UserError if it has none."""
    names = [PurePosixPath(name) for name in files_in(path)]
    if any(name.name in ("means_l.webp", "lod-meta.json") for name in names):
        raise UserError(f"{shown(path)}: is a scene, and no photos; see it with: snowsplat view")
    if not any(name.suffix.lower() in PHOTO_SUFFIXES | VIDEO_SUFFIXES for name in names):
        raise UserError(f"{shown(path)}: is a zip file without photos and videos")
    return unpack(path)


def kind_of_file(path: Path) -> Literal["photo", "video"]:
    """The kind of a file that was given as an input; it is determined by the content.

    Raises:
        UserError: neither photo nor video, or the file cannot be read.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(32)
    except OSError as error:
        raise UserError(f"{shown(path)}: cannot be read ({error.strerror})") from None
    suffix = path.suffix.lower()
    if suffix in UNREAD_SUFFIXES:  # many are TIFF files with a small preview
        raise UserError(
            f"{shown(path)}: is a {format_name(path.name)} photo, which cannot be read; save it as "
            "JPEG or PNG first"
        )
    if _is_photo(head):
        return "photo"
    if archive := other_archive(path):
        raise UserError(f"{shown(path)}: is a {archive} archive; unpack it first")
    no_video = why_no_video(path)
    if no_video is None:
        return "video"
    if suffix in PHOTO_SUFFIXES:
        raise UserError(f"{shown(path)}: not a photo, despite its extension; use another file")
    if suffix in VIDEO_SUFFIXES or no_video == ONLY_SOUND:
        raise UserError(f"{shown(path)}: {no_video}; copy it again, or use another file")
    raise UserError(f"{shown(path)}: neither a photo nor a video; use another file")


def _is_photo(head: bytes) -> bool:
    """Whether the first bytes are the signature of a photo format."""
    if head[4:8] == b"ftyp":  # HEIF shares its container with mp4
        return head[8:12] in (b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1", b"avif")
    if head[:4] == b"RIFF":
        return head[8:12] == b"WEBP"
    signatures = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*", b"BM", b"P5", b"P6")
    return head.startswith(signatures)


def _nothing_in(inputs: Sequence[Path]) -> UserError:
    names = ", ".join(map(shown, inputs))
    for path in inputs:
        if unread := unread_photos(_files_below(path), []):
            return UserError(f"{names}: {unread}")
    return UserError(
        f"{names}: no photos (JPEG, PNG, WebP, TIFF, HEIC) and no videos found; use the folder "
        "that contains them"
    )


def free_names(names: Sequence[str]) -> Iterator[str]:
    """The names, made unique: a name that equals an earlier one except for case gets a suffix.

    "a.jpg" becomes "a_2.jpg", "a_3.jpg" and so on.
    """
    taken: set[str] = set()
    for name in names:
        yield _free(name, taken)


def _free(name: str, taken: set[str]) -> str:
    """``name``, or a variant of it that is not in ``taken``; the result is added to ``taken``."""
    name = shown(name)
    path = PurePosixPath(name)
    candidate, n = name, 1
    while candidate.casefold() in taken:
        n += 1
        candidate = str(path.with_name(f"{path.stem}_{n}{path.suffix}"))
    taken.add(candidate.casefold())
    return candidate
