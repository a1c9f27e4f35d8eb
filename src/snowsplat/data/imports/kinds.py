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


@dataclass(frozen=True)
class Kind:
    """How the files of a program are found and read.

    Attributes:
        name: of the program, for messages.
        patterns: where in a dataset the files, or folders, are that describe its cameras.
        is_one: whether a file or folder is one of them.
        read: reads one of them. Errors are `UserError`.
        photos: the folder of photos, if other images of the dataset are not photos.
    """

    name: str
    patterns: tuple[str, ...]
    is_one: Callable[[Path], bool]
    read: Callable[[Path, PhotoFolder], Reconstruction]
    photos: Callable[[Path], Path | None] = _nowhere

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
    Kind("Polycam", polycam.PATTERNS, polycam.is_polycam, polycam.read, polycam.photos),
    Kind("Record3D", record3d.PATTERNS, record3d.is_record3d, record3d.read, record3d.photos),
    Kind("OpenMVG", ("sfm_data*.json",), openmvg.is_openmvg, openmvg.read),
    Kind("AliceVision", ("*.sfm", "sfm.json"), alicevision.is_alicevision, alicevision.read),
    Kind("Bundler", bundler.PATTERNS, bundler.is_bundler, bundler.read),
    Kind("OpenSfM", opensfm.PATTERNS, opensfm.is_opensfm, opensfm.read),
    Kind("LLFF", ("poses_bounds.npy",), llff.is_llff, llff.read),
)
