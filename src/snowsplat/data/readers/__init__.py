"""Datasets of other programs and apps -> posed images and points. `KINDS` lists what is read.

Nothing here undistorts photos: `PosedImage.lens` tells the lens of a distorted photo.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

from snowsplat.data.dataset import Points, PosedImage, safe_name
from snowsplat.data.files.photo_files import warn_of_missing
from snowsplat.data.readers import (
    alicevision,
    bundler,
    llff,
    metashape,
    openmvg,
    opensfm,
    polycam,
    realityscan,
    record3d,
)
from snowsplat.data.readers.reconstruction import PhotoFolder, Reconstruction, Shot
from snowsplat.scene.camera import Camera
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import quoted

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Kind:
    """How the files of a program are found and read.

    Attributes:
        name: of the program, for messages.
        patterns: where in a dataset the files, or folders, are that describe its cameras.
        is_one: whether a file or folder is one of them.
        read: reads one of them. Errors are `UserError`.
        photos: the folder of photos, if other images of the dataset are not photos.
        metres_per_unit: of its world; None: it has any unit.
    """

    name: str
    patterns: tuple[str, ...]
    is_one: Callable[[Path], bool]
    read: Callable[[Path, PhotoFolder], Reconstruction]
    photos: Callable[[Path], Path | None] = lambda folder: None
    metres_per_unit: float | None = None

    def find(self, folder: Path) -> Iterator[Path]:
        """The files that describe the cameras of a dataset, the best first.

        They are in the order of the patterns; of those of one pattern, a larger file says more.
        """
        for pattern in self.patterns:
            found = [path for path in sorted(folder.glob(pattern)) if self.is_one(path)]
            yield from sorted(found, key=lambda path: -path.stat().st_size)


#: In the order in which they are tried: files of an unmistakable kind first.
KINDS = (
    Kind("Metashape", ("*.xml",), metashape.is_metashape, metashape.read),
    Kind("RealityScan", ("*.csv",), realityscan.is_realityscan, realityscan.read),
    Kind("Polycam", polycam.PATTERNS, polycam.is_polycam, polycam.read, polycam.photos, 1.0),
    Kind("Record3D", record3d.PATTERNS, record3d.is_record3d, record3d.read, record3d.photos, 1.0),
    Kind("OpenMVG", ("sfm_data*.json",), openmvg.is_openmvg, openmvg.read),
    Kind("AliceVision", ("*.sfm", "sfm.json"), alicevision.is_alicevision, alicevision.read),
    Kind("Bundler", bundler.PATTERNS, bundler.is_bundler, bundler.read),
    Kind("OpenSfM", opensfm.PATTERNS, opensfm.is_opensfm, opensfm.read),
    Kind("LLFF", ("poses_bounds.npy",), llff.is_llff, llff.read),
)


@dataclass(frozen=True)
class Export:
    """The files of another program in a folder.

    Attributes:
        kind: the program.
        cameras: the file or folder that describes the cameras; None: there is none with poses.
        photos: the folder of the photos, if other images in the dataset are not photos.
    """

    kind: Kind
    cameras: Path | None
    photos: Path | None


def find_export(path: Path) -> Export | None:
    """The program whose files are in a folder, or that wrote the file ``path``; None if unknown.

    If there is only one folder in a folder, as unpacked archives have it, it is searched too.
    """
    if path.is_file():
        return next((Export(kind, path, None) for kind in KINDS if kind.is_one(path)), None)
    return _in_folder(path) or next(map(_in_folder, _only_folder(path)), None)


def _in_folder(folder: Path) -> Export | None:
    for kind in KINDS:
        cameras = next(kind.find(folder), None)
        photos = kind.photos(folder)
        if cameras is not None or photos is not None:
            return Export(kind, cameras, photos)
    return None


def _only_folder(folder: Path) -> list[Path]:
    """The subfolder, if a folder has one and no files; hidden ones do not count."""
    try:
        inside = [path for path in folder.iterdir() if not path.name.startswith((".", "__"))]
    except OSError:
        return []
    return inside if len(inside) == 1 and inside[0].is_dir() else []


def read_export(
    root: Path, export: Export, images: str
) -> tuple[list[PosedImage], Points | None, str]:
    """Read the posed images that are on disk, points, and a description.

    Args:
        root: the folder of the dataset, or the file of its cameras.
        export: of `find_export`, with cameras.
        images: name of the folder of images; another than ``images`` is the only one searched.

    Raises:
        UserError: damaged files, an unsupported lens, or no images.
        SettingError: there is no folder ``images``.
    """
    cameras = export.cameras
    assert cameras is not None
    folder = PhotoFolder(root.parent if root.is_file() else root, images)
    found = export.kind.read(cameras, folder)
    _check(export.kind.name, cameras, folder, found)
    shown = f"{export.kind.name} {cameras.name}"
    aligned = len(found.shots) + len(found.missing)
    description = f"{shown}, {aligned} of {found.total} photos aligned"
    if found.points_from:
        description += f", points from {found.points_from}"
    return [_posed(folder.root, shot) for shot in found.shots], found.points, description


def _check(program: str, cameras: Path, folder: PhotoFolder, found: Reconstruction) -> None:
    if not found.shots:
        if not found.missing:
            none = f"none of its {found.total} photos is aligned" if found.total else "no photos"
            raise UserError(
                "{cameras}: {none}; align them in {program}, or estimate the poses: snowsplat "
                "sfm PHOTOS -o DATASET",
                cameras=cameras,
                none=none,
                program=program,
            )
        raise UserError(
            "{cameras}: none of its {missing} photos (the first is {missing2}) is in {root}; "
            "copy them to {root2}",
            cameras=cameras,
            missing=len(found.missing),
            missing2=quoted(found.missing[0]),
            root=folder.root,
            root2=folder.root / "images",
        )
    aligned = len(found.missing) + len(found.shots)
    warn_of_missing(cameras, found.missing, aligned, "photos")
    if found.points is None:
        with_depth = any(shot.depth is not None for shot in found.shots)
        logger.warning(
            "%s: no points%s; a PLY file of them in %s is a better start",
            cameras,
            ", but depth maps, which --init depth uses" if with_depth else "",
            folder.root,
        )


def _posed(root: Path, shot: Shot) -> PosedImage:
    lens = shot.lens
    camera = Camera(
        lens.width, lens.height, *lens.intrinsics, torch.from_numpy(shot.cam_from_world.copy())
    )
    first, slash, _ = shot.photo.partition("/")
    folder = root / first if slash else root
    return PosedImage(
        safe_name(shot.photo),
        camera,
        folder,
        (root / shot.photo).relative_to(folder).as_posix(),
        depth=shot.depth,
        depth_unit=shot.depth_unit,
        depth_confidence=shot.depth_confidence,
        lens=None if lens.is_pinhole else lens,
    )
