"""`KINDS`: the programs and apps whose files are read, one row each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from snowsplat.data.imports import (
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
from snowsplat.data.imports.photos import PhotoFolder
from snowsplat.data.imports.reconstruction import Reconstruction


def _nowhere(folder: Path) -> Path | None:
    return None


def _never(path: Path) -> bool:
    return False


@dataclass(frozen=True)
class Kind:
    """How the files of a program are found and read.

    Attributes:
        name: of the program, for messages.
        find: the files, or folders, that describe the cameras of a dataset, the best first.
        read: reads one of them. Errors are `UserError`.
        reads_file: whether a file is one of them.
        photos: the folder of photos, if other images of the dataset are not photos.
    """

    name: str
    find: Callable[[Path], Iterator[Path]]
    read: Callable[[Path, PhotoFolder], Reconstruction]
    reads_file: Callable[[Path], bool] = _never
    photos: Callable[[Path], Path | None] = _nowhere


#: In the order in which they are tried: files of an unmistakable kind first.
KINDS = (
    Kind("Metashape", metashape.find, metashape.read, metashape.is_metashape),
    Kind("RealityScan", realityscan.find, realityscan.read, realityscan.is_realityscan),
    Kind("Polycam", polycam.find, polycam.read, photos=polycam.photos),
    Kind("Record3D", record3d.find, record3d.read, record3d.is_record3d, record3d.photos),
    Kind("OpenMVG", openmvg.find, openmvg.read, openmvg.is_openmvg),
    Kind("AliceVision", alicevision.find, alicevision.read, alicevision.is_alicevision),
    Kind("Bundler", bundler.find, bundler.read, bundler.is_bundler),
    Kind("OpenSfM", opensfm.find, opensfm.read, opensfm.is_opensfm),
    Kind("LLFF", llff.find, llff.read, llff.is_llff),
)
