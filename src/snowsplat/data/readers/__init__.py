"""Readers of datasets: what tells the poses of photos -> posed images and points.

A reader is a module with a `Reader`, and a line in `READERS`. Nothing here undistorts photos:
`PosedImage.lens` tells the lens of a photo.
"""

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from snowsplat.data.colmap.places import folders_below
from snowsplat.data.files.photo_files import photos_below
from snowsplat.data.photos.decode import is_photo
from snowsplat.data.readers import (
    alicevision,
    bundler,
    colmap,
    llff,
    metashape,
    openmvg,
    opensfm,
    polycam,
    pose_matrices,
    realityscan,
    record3d,
    transforms_json,
)
from snowsplat.data.readers.projects import DEEPEST, advice
from snowsplat.data.readers.reconstruction import PhotoFolder, Reader, Reconstruction
from snowsplat.util.errors import UserError

#: The exports of programs, in the order in which they are tried: unmistakable files first.
PROGRAMS = (
    metashape.READER,
    realityscan.READER,
    realityscan.XMP_READER,
    polycam.READER,
    record3d.READER,
    openmvg.READER,
    alicevision.READER,
    bundler.READER,
    opensfm.READER,
    llff.READER,
    *pose_matrices.READERS,
)
#: All readers; the first one that finds its files in a folder is used.
READERS = (colmap.READER, transforms_json.READER, *PROGRAMS)


class NoPosesError(UserError):
    """A folder has no camera poses, so it is not a dataset; it may have photos."""


@dataclass(frozen=True)
class Poses:
    """The files that tell the poses of a dataset, the first of which counts, and their reader."""

    reader: Reader
    files: list[Path]


def find_poses(root: Path, images: str = "images", *, deep: bool = True) -> Poses | None:
    """What tells the poses of the images in a folder, or the file ``root``; None: nothing.

    Args:
        images: name of the folder of images.
        deep: also models of COLMAP in other folders than ``sparse``, and exports of programs in
            folders without photos, which may be those of other photos.

    Raises: UserError: there are several datasets.
    """
    # Any JSON file may be a transforms.json.
    for reader in (*PROGRAMS, transforms_json.READER) if root.is_file() else READERS:
        if files := reader.find(root, images, deep):
            return Poses(reader, files)
    below = islice(folders_below(root, DEEPEST), 1, None) if deep and root.is_dir() else ()
    found = [
        Poses(reader, files)
        for folder in below
        if not _has_photos(folder)
        for reader in PROGRAMS
        if (files := reader.find(folder, images, False)) and not _has_photos(files[0].parent)
    ]
    return max(found, key=lambda poses: poses.files[0].stat().st_size, default=None)


def _has_photos(folder: Path) -> bool:
    try:
        return any(is_photo(path.name) for path in folder.iterdir())
    except OSError:  # a folder that cannot be read
        return False


def poses_in(root: Path) -> Path | None:
    """What tells the poses of the photos in a folder, relative to it, as sparse/0; or None."""
    try:
        poses = find_poses(root) if root.is_dir() else None
    except UserError:  # several datasets
        return None
    return None if poses is None else poses.files[0].relative_to(root)


def is_export(path: Path) -> bool:
    """Whether a file is the export of a program."""
    return any(reader.find(path, "images", False) for reader in PROGRAMS)


def photo_folder(root: Path) -> tuple[str, Path] | None:
    """The program whose capture is in a folder, and the folder of its photos, if other images of
    the capture are not photos."""
    for reader in PROGRAMS:
        if (folder := reader.photos(root)) is not None:
            return reader.name, folder
        if reader.find(root, "images", False):
            break
    return None


def read_poses(root: Path, images: str = "images") -> Reconstruction:
    """Read the posed images and points of a dataset: a folder, or a file of poses.

    ``images``: name of the folder of images.

    Raises:
        NoPosesError: there are none.
        UserError: damaged files, an unsupported lens, or no images.
        SettingError: there is no folder ``images``.
    """
    if not root.exists():
        raise UserError("{root}: no such folder", root=root)
    poses = find_poses(root, images)
    folder = root.parent if root.is_file() else root
    if poses is None or poses.reader is colmap.READER:
        _check_folder(root, images, poses)
    if poses is not None:
        return poses.reader.read(poses.files, PhotoFolder(folder, images))
    if (known := advice(root)) is not None:
        raise NoPosesError(
            "{root}: no camera poses that can be read here; {known}", root=root, known=known
        )
    raise NoPosesError(
        "{root}: no camera poses here (neither sparse/0 of COLMAP nor transforms.json); to "
        "estimate the poses of photos, run: snowsplat sfm PHOTOS -o DATASET",
        root=root,
    )


def _check_folder(root: Path, images: str, poses: Poses | None) -> None:
    """Raise `UserError` if a path is no folder, or a part of a dataset."""
    if root.suffix.lower() == ".zip" and root.is_file():
        raise UserError(
            "{root}: is a zip file; unpack it and use its folder, or if there are only photos in "
            "it, run: snowsplat make {root} -o OUT",
            root=root,
        )
    if root.is_file():
        raise UserError("{root}: not a dataset; use its folder, or a transforms.json", root=root)
    if poses is None or not ((root / images).is_dir() or photos_below(root)):
        parents = root.absolute().parents[:2]
        above = next((p for p in parents if find_poses(p, images, deep=False)), None)
        if above is not None:
            raise UserError(
                "{root}: a part of a dataset; use the whole: {above}", root=root, above=above
            )
