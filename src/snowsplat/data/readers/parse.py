"""Reading the files of other programs: bounded memory, numbers that are finite, true rotations."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np

from snowsplat.util.errors import Problem, UserError
from snowsplat.util.files import reading
from snowsplat.util.messages import Message
from snowsplat.util.safe_json import encoding_of, lenient, quoted, read_json

#: Memory for JSON values per byte of the text. A point of OpenSfM needs 7 times its text.
_JSON_RATIO = 8
#: Largest text or XML file in bytes.
_MOST_BYTES = 1 << 30
#: An XML file may have this number of elements, and one more for so many bytes.
_ELEMENTS, _BYTES_PER_ELEMENT = 50_000, 20
#: Largest coordinate, focal length or coefficient.
_MOST = 1e15
#: Largest width or height in pixels.
_MOST_SIDE = 1_000_000


def damaged(where: object, problem: str | Message) -> UserError:
    """The error for a file that does not follow its format."""
    return UserError("{where}: {problem}; export the file again", where=where, problem=problem)


def load_json(path: Path, ratio: int = _JSON_RATIO) -> Any:
    """The value in a JSON file.

    ``ratio``: see `parse_json`.

    Raises: UserError: the file cannot be read, or is not JSON.
    """
    try:
        with reading(path):
            return read_json(path, ratio)
    except ValueError as error:  # not JSON, or not even text
        raise UserError(
            "{path}: not a complete JSON file ({error}); copy it again",
            path=path,
            error=str(error)[:80],
        ) from None


def load_text(path: Path) -> str:
    """The text of a file, see `encoding_of`. Invalid bytes stay as they are in file names.

    Raises: UserError: the file cannot be read.
    """
    data = _load_bytes(path)
    return data.decode(*lenient(encoding_of(data)))


def load_xml(path: Path) -> Element:
    """The root element of an XML file. Files with a document type, which may define entities, are
    refused.

    Raises: UserError: the file cannot be read, or is not XML.
    """
    data = _load_bytes(path)
    most = _ELEMENTS + len(data) // _BYTES_PER_ELEMENT
    builder = TreeBuilder()
    parser = expat.ParserCreate()
    count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if count > most:
            raise Problem("too many elements")
        builder.start(tag, attributes)

    def refuse(*_: object) -> None:
        raise Problem("has a document type")

    parser.StartElementHandler = start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(data, True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise damaged(path, f"not a complete XML file ({quoted(error)})") from None


def head_of(path: Path, size: int = 1 << 12) -> bytes:
    """The first bytes of a file; empty if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return file.read(size)
    except OSError:
        return b""


def numbers(where: object, value: Any, *shape: int) -> np.ndarray:
    """A float64 array of this shape from nested lists of numbers, or of numbers as text.

    Raises:
        UserError: another shape; not numbers; not finite or implausibly large.
    """
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if array.shape != shape or not (np.abs(array) < _MOST).all():
        raise damaged(where, f"should be {math.prod(shape)} numbers, not {quoted(value)}")
    return array


def number(
    where: object, values: Mapping[str, Any], key: str, default: float | None = None
) -> float:
    """The number ``values[key]``, which may be text; ``default`` if it is missing.

    Raises:
        UserError: it is missing without a default, or not a plausible number.
    """
    value = values.get(key, default)
    try:
        result = math.nan if isinstance(value, bool | None) else float(value)
    except (TypeError, ValueError, OverflowError):
        result = math.nan
    if not abs(result) < _MOST:
        raise damaged(where, f"{key} should be a number, not {quoted(value)}")
    return result


def size_of(where: object, width: float, height: float) -> tuple[int, int]:
    """Width and height in pixels; raises `UserError` if they are not plausible."""
    if not (1 <= width <= _MOST_SIDE and 1 <= height <= _MOST_SIDE):
        raise damaged(where, f"the image size {width:g}x{height:g} is not valid")
    return round(width), round(height)


def objects(where: object, value: Any) -> Iterator[dict[str, Any]]:
    """The objects of a JSON list; raises `UserError` if it is not a list of objects."""
    if not isinstance(value, list) or not all(isinstance(each, dict) for each in value):
        raise damaged(where, "should be a list of objects")
    return iter(value)


def table(where: object, value: Any) -> dict[str, Any]:
    """A JSON object; raises `UserError` for other values."""
    if not isinstance(value, dict):
        raise damaged(where, f"should be an object, not {quoted(value)}")
    return value


def rigid(where: object, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(3, 4) float64: the nearest rotation to a matrix (3, 3), beside a translation (3,).

    It corrects the rounding errors of files.

    Raises:
        UserError: the matrix is not a rotation.
    """
    u, _, vt = np.linalg.svd(rotation)
    nearest = u @ vt
    if np.abs(nearest - rotation).max() > 1e-2 or np.linalg.det(nearest) < 0:
        raise damaged(where, "the rotation of the camera is not a rotation")
    return np.column_stack([nearest, translation])


def inverse(pose: np.ndarray) -> np.ndarray:
    """(3, 4): the inverse of a rigid transform (3, 4)."""
    rotation = pose[:, :3].T
    return np.column_stack([rotation, -rotation @ pose[:, 3]])


def from_opengl(where: object, world_from_cam: np.ndarray) -> np.ndarray:
    """cam_from_world (3, 4), OpenCV axes, of a camera (3, 4) whose y is up and that looks along −z.

    Raises: UserError: its matrix is not a rotation.
    """
    flipped = world_from_cam[:, :3] * (1.0, -1.0, -1.0)
    return inverse(rigid(where, flipped, world_from_cam[:, 3]))


def _load_bytes(path: Path) -> bytes:
    with reading(path):
        if path.stat().st_size > _MOST_BYTES:
            raise UserError("{path}: larger than 1 GiB, which is not supported", path=path)
        return path.read_bytes()
