"""RealityScan and RealityCapture: the CSV file "Internal/External camera parameters".

The position is in the world frame, whose z is up. Heading, pitch and roll in degrees are rotations
about z (clockwise), x and y, of a camera with y up that looks along −z. Lengths in the photo are in
units of its larger side, except that the focal length is multiplied by 36 mm. RealityScan's own
export for OpenCV shows that t₁ and t₂ are p₂ and p₁ of OpenCV.
"""

from __future__ import annotations

import csv
import logging
import math
from pathlib import Path

import numpy as np

from snowsplat.data.photos.decode import read_header
from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import perspective
from snowsplat.data.readers.points import points_beside
from snowsplat.data.readers.reconstruction import PhotoFolder, Reconstruction, program
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import encoding_of, quoted

logger = logging.getLogger(__name__)

# Names in older and newer versions.
_RENAMED = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
_NEEDED = {"name", "x", "y", "alt", "heading", "pitch", "roll", "f"}
_POSITIONS = {"name", "x", "y", "alt"}


def is_realityscan(path: Path) -> bool:
    """Whether a file is a table of cameras, with or without all columns that are needed."""
    if path.suffix.lower() != ".csv":
        return False
    head = parse.head_of(path)
    lines = head.decode(encoding_of(head), "replace").splitlines()
    return any(line.startswith("#") and set(_columns(line)) >= _POSITIONS for line in lines[:2])


def read(path: Path, photos: PhotoFolder) -> Reconstruction:
    """Read cameras, and the points of a PLY file beside it."""
    lines = parse.load_text(path).splitlines()
    first = next(i for i, line in enumerate(lines) if set(_columns(line)) >= _POSITIONS)
    columns = _columns(lines[first])
    if not set(columns) >= _NEEDED:
        raise UserError(
            "{path}: has no column {set}; export the alignment as Internal/External camera "
            "parameters",
            path=path,
            set=sorted(_NEEDED - set(columns))[0],
        )
    found = Reconstruction()
    division = True
    try:
        rows = [row for row in csv.reader(lines[first + 1 :]) if row and row[0].strip()]
    except csv.Error as error:
        raise parse.damaged(path, f"not a complete CSV file ({error})") from None
    for row in rows:
        with found.one(row[0]):
            if len(row) != len(columns):
                raise parse.damaged(
                    path, f"a line has {len(row)} columns instead of {len(columns)}"
                )
            values = dict(zip(columns, row, strict=True))
            where = f"{path}: camera {quoted(values['name'])}"
            found.total += 1
            if (photo := found.photo(photos, values["name"])) is None:
                continue
            header = read_header(photos.root / photo)
            width, height = header.width, header.height
            unit = max(width, height)
            focal = parse.number(where, values, "f") * unit / 36.0
            cx = parse.number(where, values, "px", 0.0) * unit + width / 2
            cy = parse.number(where, values, "py", 0.0) * unit + height / 2
            radial = [parse.number(where, values, f"k{i}", 0.0) for i in (1, 2, 3, 4)]
            tangential = (
                parse.number(where, values, "t2", 0.0),
                parse.number(where, values, "t1", 0.0),
            )
            lens = perspective(where, width, height, (focal, focal, cx, cy), radial, tangential)
            division &= radial[0] != 0 and not any((*radial[1:], *tangential))
            position = [parse.number(where, values, key) for key in ("x", "y", "alt")]
            angles = [
                math.radians(parse.number(where, values, k)) for k in ("heading", "pitch", "roll")
            ]
            pose = np.column_stack([_rotation(*angles), position])
            found.add(photos, photo, lens, parse.from_opengl(where, pose))
    _warn(path, found, division)
    points_beside(path.parent, found)
    return found


def _columns(line: str) -> list[str]:
    names = (name.strip().lower() for name in line.lstrip("#").split(","))
    return [_RENAMED.get(name, name) for name in names]


def _rotation(heading: float, pitch: float, roll: float) -> np.ndarray:
    """(3, 3): world_from_cam for angles in radians."""
    (sh, sp, sr), (ch, cp, cr) = np.sin((heading, pitch, roll)), np.cos((heading, pitch, roll))
    about_z = np.array([[ch, sh, 0], [-sh, ch, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_y = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    return about_z @ about_x @ about_y


def _warn(path: Path, found: Reconstruction, division: bool) -> None:
    if len(found.images) < 2:
        return
    if division:
        logger.warning(
            "%s: the lenses have k1 only, so they may be of the division model, which the file "
            "does not tell; they are read as Brown's model; align with Brown3 if that is wrong",
            path,
        )
    centres = np.stack([image.camera.position.numpy() for image in found.images])
    across, up = np.ptp(centres[:, :2], axis=0).max(), np.ptp(centres[:, 2])
    degrees = (np.abs(centres[:, :2]) <= (180.0, 90.0)).all() and across < 0.1
    if degrees and across < 0.01 * up:
        raise UserError(
            "{path}: the positions are longitude and latitude; export the cameras in the "
            "coordinate system Local Euclidean",
            path=path,
        )


READER = program("RealityScan", ("*.csv",), is_realityscan, read)
