"""Scene files: one module per format, one entry per format in `FORMATS`.

`read_gaussians` and `write_gaussians` handle every format. The modules of the formats read and
write `GaussianArrays` with NumPy; torch is imported when these become `Gaussians`.
"""

from __future__ import annotations

import logging
import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from snowsplat.formats.gaussian_arrays import GaussianArrays
from snowsplat.formats.origin_file import Place, read_place, written_with_place
from snowsplat.formats.registry import (
    FORMATS,
    Format,
    format_for_reading,
    format_for_writing,
    register_format,
)
from snowsplat.scene.origin import add_origins
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.scene.gaussians import Gaussians

logger = logging.getLogger(__name__)

_SAMPLE = 1 << 14  # Gaussians from which precision is estimated
_POINT = 1e-11  # a standard deviation of 0 is read as 1e-12

__all__ = [
    "FORMATS",
    "Format",
    "GaussianArrays",
    "format_for_reading",
    "format_for_writing",
    "read_arrays",
    "read_gaussians",
    "register_format",
    "write_gaussians",
]


def read_arrays(path: Path | str) -> GaussianArrays:
    """Read a scene file of any known format, in the PLY frame (x right, y down, z forward).

    Raises:
        UserError: the file is missing, damaged, of an unknown format, or contains no Gaussians.
    """
    path = Path(path)
    format = format_for_reading(path)
    if format.read is None:
        raise UserError(
            "{path}: {name} files cannot be read; {instead}",
            path=path,
            name=format.name,
            instead=format.instead,
        )
    scene = format.read(path)
    _name_coarse_positions(path, scene)
    if format.stores_origin:
        return scene
    origin, metres = read_place(path)
    return replace(scene, origin=add_origins(scene.origin, origin), metres_per_unit=metres)


def _name_coarse_positions(path: Path, scene: GaussianArrays) -> None:
    """Warn if the positions in a file are rounded by more than a tenth of a Gaussian. float32 is
    coarse far away from 0; only a program that has the exact positions can mend this."""
    sample = scene.select(slice(None, None, len(scene.means) // _SAMPLE + 1))
    sample = sample.select(sample.usable_rows())
    if not len(sample.means):
        return
    farthest = float(np.abs(np.median(sample.means, 0)).max())
    step = float(np.spacing(np.float32(farthest)))
    size = math.exp(min(80.0, float(np.median(sample.log_scales.max(1)))))
    if 0.1 * size < step and size > _POINT:
        logger.warning(
            "%s: its positions are rounded to steps of %.2g, because they are %.4g from 0; export "
            "it nearer to 0, or as a PLY with doubles",
            path,
            step,
            farthest,
        )


def read_gaussians(path: Path | str) -> Gaussians:
    """Read a scene file as `read_arrays` does, as tensors on the CPU."""
    return read_arrays(path).to_gaussians()


def write_gaussians(path: Path | str, gaussians: Gaussians, **options: Any) -> None:
    """Write a scene file atomically, in the format that the suffix of its name selects.

    The origin and the true scale of a scene that has them are in the file or, if the format cannot
    store them, in NAME.origin.json beside it.

    Args:
        options: of the function that writes the format, such as ``version`` of `write_spz`.

    Raises:
        UserError: the suffix belongs to no format that can be written.
        OSError: the folder is missing or not writable, or the disk is full.
    """
    path = Path(path)
    format = format_for_writing(path)
    assert format.write is not None
    place = Place(gaussians.origin, gaussians.metres_per_unit) if format.read else Place()
    with nullcontext() if format.stores_origin else written_with_place(path, place):
        format.write(path, GaussianArrays.from_gaussians(gaussians), **options)
    if gaussians.antialiased and not format.marks_antialiased:
        logger.warning(
            "%s: the scene is antialiased, but %s files cannot say so: viewers will show fine "
            "details too thick; write .ply, .spz or .sog",
            path,
            format.name,
        )
