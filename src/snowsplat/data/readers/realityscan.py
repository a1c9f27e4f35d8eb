"""RealityScan and RealityCapture: the CSV file "Internal/External camera parameters", and the XMP
file of each photo.

The position is in the world frame, whose z is up. Heading, pitch and roll in degrees are rotations
about z (clockwise), x and y, of a camera with y up that looks along −z. Lengths in the photo are in
units of its larger side, except that the focal length is multiplied by 36 mm. RealityScan's own
export for OpenCV shows that t₁ and t₂ are p₂ and p₁ of OpenCV.

An XMP file has cam_from_world as a rotation, by rows, in OpenCV axes, and the position of the
camera (the help page "RealityCapture XMP Camera Math"). Its lengths are as those of the table.
"""

import csv
import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.data.lens.lens import Lens
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
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "t1", "t2")
_XCR = "http://www.capturingreality.com/ns/xcr/1.1#"
_XMP_KEYS = {"f": "FocalLength35mm", "px": "PrincipalPointU", "py": "PrincipalPointV"}
_MODELS = ("perspective", "brown")


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
            coefficients = [parse.number(where, values, key, 0.0) for key in _COEFFICIENTS]
            lens = _lens(where, photos.root / photo, values, coefficients)
            division &= coefficients[0] != 0 and not any(coefficients[1:])
            position = [parse.number(where, values, key) for key in ("x", "y", "alt")]
            angles = [
                math.radians(parse.number(where, values, k)) for k in ("heading", "pitch", "roll")
            ]
            pose = np.column_stack([_rotation(*angles), position])
            found.add(photos, photo, lens, parse.from_opengl(where, pose))
    _warn(path, found, division)
    points_beside(path.parent, found)
    return found


def _lens(
    where: str, photo: Path, values: Mapping[str, Any], coefficients: Sequence[float]
) -> Lens:
    """``values``: f, px and py; ``coefficients``: k₁ k₂ k₃ k₄ t₁ t₂."""
    header = read_header(photo)
    width, height = header.width, header.height
    unit = max(width, height)
    focal = parse.number(where, values, "f") * unit / 36.0
    cx = parse.number(where, values, "px", 0.0) * unit + width / 2
    cy = parse.number(where, values, "py", 0.0) * unit + height / 2
    *radial, t1, t2 = coefficients
    return perspective(where, width, height, (focal, focal, cx, cy), radial, (t2, t1))


def is_xmp(path: Path) -> bool:
    """Whether a file is the XMP of a photo with a pose."""
    if path.suffix.lower() != ".xmp":
        return False
    head = parse.head_of(path)
    return _XCR.encode() in head and b"Position" in head


def read_xmp(path: Path, photos: PhotoFolder) -> Reconstruction:
    """Read the XMP files of all photos in the folder of ``path``, and the points of a PLY file."""
    found = Reconstruction()
    for file in sorted(path.parent.glob("*.[xX][mM][pP]")):
        if not is_xmp(file):
            continue
        found.total += 1
        with found.one(file.name):
            if (photo := found.photo(photos, file.stem)) is None:
                continue
            values: dict[str, str] = {}
            for element in parse.load_xml(file).iter():
                values |= element.attrib | {element.tag: element.text or ""}
            values = {key.removeprefix("xcr:"): text for key, text in values.items()}
            model = values.get("DistortionModel", "")
            exact = [parse.number(file, values, key, 0.0) for key in ("Skew", "AspectRatio")]
            if not model.startswith(_MODELS) or exact[0] != 0 or exact[1] not in (0, 1):
                raise UserError(
                    "{path}: the lens model {model} is not supported; align with Brown3, without "
                    "skew and aspect ratio",
                    path=file,
                    model=quoted(model),
                )
            numbers = values.get("DistortionCoeficients", "0 0 0 0 0 0").split()
            coefficients = parse.numbers(file, numbers, 6).tolist()
            named = {short: values[key] for short, key in _XMP_KEYS.items() if key in values}
            lens = _lens(str(file), photos.root / photo, named, coefficients)
            rotation = parse.numbers(file, values.get("Rotation", "").split(), 9).reshape(3, 3)
            position = parse.numbers(file, values.get("Position", "").split(), 3)
            found.add(photos, photo, lens, parse.rigid(file, rotation, -rotation @ position))
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
XMP_READER = program("RealityCapture", ("*.xmp",), is_xmp, read_xmp)
