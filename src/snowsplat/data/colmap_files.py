"""COLMAP's files, binary and text: cameras, images (poses) and 3D points, read and written.

The format: https://colmap.github.io/format.html. Counts in the files are never trusted: what they
promise must fit into the file before anything is allocated.
"""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from snowsplat.data.dataset import Points
from snowsplat.util.errors import UserError
from snowsplat.util.files import shown

logger = logging.getLogger(__name__)

#: Camera models in the order of their numbers in binary files: name, number of parameters.
CAMERA_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
)
_MAX_SIDE = 1_000_000  # pixels; anything larger is a damaged file
_FARTHEST = 1e18  # where a point may be: squares of distances have to be finite in float32
_MOST_IMAGES = 200_000  # and cameras; each takes some 400 bytes of memory
_MOST_WORDS = 20  # of a camera
_LINES_AT_ONCE, _PIECE = 50_000, 1 << 20  # of a text, characters of a line

_CAMERA_HEAD = struct.Struct("<IiQQ")  # id, model, width, height
_IMAGE_HEAD = struct.Struct("<I4d3dI")  # id, quaternion wxyz, translation, camera id; then its name
_POINT_BYTES = 8 + 24 + 3 + 8 + 8  # id, xyz, rgb, error, length of the track; then 8 bytes for each
_COUNT = struct.Struct("<Q")


@dataclass(frozen=True)
class ColmapCamera:
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    name: str
    camera_id: int
    pose: tuple[float, ...]  # cam_from_world: quaternion wxyz, translation


@dataclass(frozen=True)
class ColmapModel:
    folder: Path
    text: bool
    cameras: Mapping[int, ColmapCamera]
    images: Sequence[ColmapImage]


def model_is_text(folder: Path) -> bool | None:
    """Whether the model in a folder is text (True), binary (False), or there is none (None)."""
    for text, suffix in ((False, ".bin"), (True, ".txt")):
        if all((folder / (name + suffix)).is_file() for name in ("cameras", "images")):
            return text
    return None


def count_images(folder: Path) -> int:
    """How many images a model has registered, without reading all of it; 0 where it is damaged."""
    if model_is_text(folder):
        try:
            return len(_read_images_text(folder / "images.txt"))
        except UserError:
            return 0
    path = folder / "images.bin"
    with open(path, "rb") as file:
        head = file.read(_COUNT.size)
    most = path.stat().st_size // (_IMAGE_HEAD.size + 1 + _COUNT.size)
    return min(_COUNT.unpack(head)[0], most) if len(head) == _COUNT.size else 0


def read_model(folder: Path) -> ColmapModel:
    """Read cameras and images of the model in a folder, in the order of the images' names.

    Raises:
        UserError: no model there, or one that is damaged; names the file.
    """
    text = model_is_text(folder)
    if text is None:
        raise UserError(f"{folder}: no COLMAP model here (cameras and images, .bin or .txt)")
    if text:
        cameras = _read_cameras_text(folder / "cameras.txt")
        images = _read_images_text(folder / "images.txt")
    else:
        cameras = _read_cameras_binary(folder / "cameras.bin")
        images = _read_images_binary(folder / "images.bin")
    return ColmapModel(folder, text, cameras, sorted(images, key=lambda image: image.name))


def read_points(folder: Path) -> Points | None:
    """The 3D points of the model in a folder; None where it has none.

    Points that are not finite, or absurdly far, are left out, with a warning.

    Raises:
        UserError: a damaged file.
    """
    binary, text = folder / "points3D.bin", folder / "points3D.txt"
    if binary.is_file():
        xyz, rgb = _read_points_binary(binary)
    elif text.is_file():
        xyz, rgb = _read_points_text(text)
    else:
        return None
    return make_points(binary if binary.is_file() else text, xyz, rgb)


def make_points(path: Path, xyz: np.ndarray, rgb: np.ndarray) -> Points | None:
    """Points of positions (P, 3), as float32; those that it does not fit left out with a warning.

    It fits those whose squares of distances are finite, too.
    """
    with np.errstate(over="ignore"):
        xyz = np.ascontiguousarray(xyz, np.float32)
    finite = (np.abs(xyz) < _FARTHEST).all(axis=1)
    if not finite.all():
        count = (~finite).sum()
        logger.warning("%s: %d points are not finite, or absurdly far; left out", path, count)
        xyz, rgb = xyz[finite], rgb[finite]
    if not len(xyz):
        return None
    return Points(torch.from_numpy(xyz), torch.from_numpy(np.ascontiguousarray(rgb, np.uint8)))


# Binary


class _Cursor:
    """Reads a little-endian file front to back; what is not there is a UserError."""

    def __init__(self, path: Path, kind: str, least_bytes: int) -> None:
        self.path = path
        self.data = _read(path)
        self.offset = 0
        (self.count,) = self.take(_COUNT)
        if self.count * least_bytes > len(self.data) - self.offset:
            raise self.damaged(f"it promises {self.count} {kind}, more than fit into it")

    def take(self, layout: struct.Struct) -> tuple:
        if self.offset + layout.size > len(self.data):
            raise self.damaged("it is cut short")
        values = layout.unpack_from(self.data, self.offset)
        self.offset += layout.size
        return values

    def take_string(self) -> str:
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise self.damaged("it is cut short")
        text = self.data[self.offset : end].decode("utf-8", errors="surrogateescape")
        self.offset = end + 1
        return text

    def skip(self, size: int) -> None:
        if size > len(self.data) - self.offset:
            raise self.damaged("it is cut short")
        self.offset += size

    def finish(self) -> None:
        if self.offset != len(self.data):
            raise self.damaged(f"{len(self.data) - self.offset} bytes are left over at its end")

    def damaged(self, what: str) -> UserError:
        return _damaged(self.path, what)


def _damaged(path: Path, what: str) -> UserError:
    return UserError(f"{path}: damaged: {what}; copy the file again or run COLMAP again")


def _check_number(path: Path, kind: str, count: int) -> None:
    if count > _MOST_IMAGES:
        raise UserError(f"{path}: more than {_MOST_IMAGES:,} {kind}, the most that I take")


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None


def _checked_camera(path: Path, model: str, width: int, height: int, params: tuple) -> ColmapCamera:
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE):
        raise _damaged(path, f"a camera's size is {width}x{height}")
    return ColmapCamera(model, width, height, params)


def _read_cameras_binary(path: Path) -> dict[int, ColmapCamera]:
    cursor = _Cursor(path, "cameras", _CAMERA_HEAD.size + 3 * 8)
    _check_number(path, "cameras", cursor.count)
    cameras = {}
    for _ in range(cursor.count):
        camera_id, number, width, height = cursor.take(_CAMERA_HEAD)
        if not 0 <= number < len(CAMERA_MODELS):
            raise UserError(
                f"{path}: unknown camera model {number}; undistort the images first "
                "(colmap image_undistorter), or copy the file again if it is damaged"
            )
        model, count = CAMERA_MODELS[number]
        params = cursor.take(struct.Struct(f"<{count}d"))
        cameras[camera_id] = _checked_camera(path, model, width, height, params)
    cursor.finish()
    return cameras


def _read_images_binary(path: Path) -> list[ColmapImage]:
    cursor = _Cursor(path, "images", _IMAGE_HEAD.size + 1 + _COUNT.size)
    _check_number(path, "images", cursor.count)
    images = []
    for _ in range(cursor.count):
        _, *pose, camera_id = cursor.take(_IMAGE_HEAD)
        name = cursor.take_string()
        (observations,) = cursor.take(_COUNT)
        cursor.skip(24 * observations)  # x, y, point id
        images.append(ColmapImage(name, camera_id, tuple(pose)))
    cursor.finish()
    return images


def _read_points_binary(path: Path) -> tuple[np.ndarray, np.ndarray]:
    cursor = _Cursor(path, "points", _POINT_BYTES)
    # A record's length is known from the record itself only, so their starts are found one by one;
    # all else is done for all records at once.
    data, size = cursor.data, len(cursor.data)
    starts = np.empty(cursor.count, np.int64)
    unpack = _COUNT.unpack_from
    start = _COUNT.size
    for i in range(cursor.count):
        if start + _POINT_BYTES > size:
            raise cursor.damaged("it is cut short")
        starts[i] = start
        start += _POINT_BYTES + 8 * unpack(data, start + _POINT_BYTES - _COUNT.size)[0]
    if start > size:
        raise cursor.damaged("it is cut short")
    cursor.offset = start
    cursor.finish()
    # A view with a record at every byte, of which those at the starts are taken.
    record = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3)])
    everywhere: np.ndarray = np.ndarray(
        max(0, size - record.itemsize + 1), record, data, strides=(1,)
    )
    records = everywhere[starts]
    return records["xyz"], records["rgb"]


# Text


def _lines(path: Path) -> Iterator[str]:
    """The lines of a text file, without comments."""
    try:
        with open(path, encoding="utf-8", errors="surrogateescape") as file:
            for line in file:
                if not line.startswith("#"):
                    yield line.strip()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None


def _count_words(line: str) -> int:
    """How many `str.split` gives, which takes 60 bytes of memory for each: piece by piece."""
    count = 0
    for start in range(0, len(line), _PIECE):
        piece = line[start : start + _PIECE]
        goes_on = start > 0 and not line[start - 1].isspace() and not piece[0].isspace()
        count += len(piece.split()) - goes_on
    return count


def _warn_if_fewer(path: Path, kind: str, count: int) -> None:
    # COLMAP notes the number in a comment, which may be stale where a person edited the file.
    with open(path, encoding="utf-8", errors="replace") as file:
        head = file.read(1000)
    noted = re.search(rf"^#.*Number of {kind}: (\d{{1,12}})\b", head, re.MULTILINE)
    if noted and int(noted[1]) > count:
        logger.warning(
            "%s: has %d %s, its comment says %s; cut short?", path, count, kind, noted[1]
        )


def _read_cameras_text(path: Path) -> dict[int, ColmapCamera]:
    counts = dict(CAMERA_MODELS)
    cameras = {}
    for line in filter(None, _lines(path)):
        words = line.split(maxsplit=_MOST_WORDS)
        try:
            camera_id, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            params = tuple(float(word) for word in words[4:])
        except (ValueError, IndexError):
            raise _damaged(path, f"no camera in the line {shown(line[:60])!r}") from None
        if len(params) != counts.get(model, len(params)):
            raise _damaged(path, f"{len(params)} parameters for camera model {model[:40]}")
        cameras[camera_id] = _checked_camera(path, model, width, height, params)
        _check_number(path, "cameras", len(cameras))
    _warn_if_fewer(path, "cameras", len(cameras))
    return cameras


def _read_images_text(path: Path) -> list[ColmapImage]:
    images = []
    lines = _lines(path)
    for line in filter(None, lines):
        words = line.split(maxsplit=9)
        try:
            pose = tuple(float(word) for word in words[1:8])
            image = ColmapImage(words[9], int(words[8]), pose)
        except (ValueError, IndexError):
            raise _damaged(path, f"no image in the line {shown(line[:60])!r}") from None
        images.append(image)
        _check_number(path, "images", len(images))
        observations = next(lines, "")  # x, y, point id of each; the line may be empty
        if _count_words(observations) % 3:
            name = image.name[:80]
            raise _damaged(path, f"the line after image {name} should be its observations")
    _warn_if_fewer(path, "images", len(images))
    return images


def _read_points_text(path: Path) -> tuple[np.ndarray, np.ndarray]:
    # Rows have tracks of different lengths; numpy's reader is fast and takes the first columns, of
    # which we give it no more: it would make words of the whole track.
    lines = (" ".join(line.split(maxsplit=8)[:8]) for line in _lines(path) if line)
    xyz, rgb = [np.empty((0, 3))], [np.empty((0, 3), np.uint8)]
    while piece := list(islice(lines, _LINES_AT_ONCE)):
        try:
            values = np.loadtxt(
                piece, np.float64, comments=None, usecols=(1, 2, 3, 4, 5, 6, 7), ndmin=2
            )
        except (ValueError, IndexError) as error:
            raise _damaged(path, f"no points ({' '.join(str(error).split())[:90]})") from None
        colours = values[:, 3:6]
        if not ((colours >= 0) & (colours <= 255)).all():
            raise _damaged(path, "a colour is outside 0..255")
        xyz.append(values[:, :3].copy())
        rgb.append(colours.astype(np.uint8))
    _warn_if_fewer(path, "points", sum(map(len, xyz)))
    return np.concatenate(xyz), np.concatenate(rgb)


# Writing


def write_model(
    folder: Path,
    cameras: Mapping[int, ColmapCamera],
    images: Sequence[ColmapImage],
    xyz: np.ndarray,
    rgb: np.ndarray,
    tracks: Sequence[Sequence[tuple[int, int]]] | None = None,
    *,
    text: bool = False,
) -> None:
    """Write a sparse model: cameras, images, points3D, as .bin or .txt.

    Args:
        images: numbered from 1 in this order; written without observations.
        xyz: (P, 3) world positions, with colours ``rgb`` (P, 3) uint8; numbered from 1.
        tracks: for each point, the pairs (image number, observation number) that saw it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tracks = [()] * len(xyz) if tracks is None else tracks
    if text:
        contents = _text_files(cameras, images, xyz, rgb, tracks)
        for name, lines in contents.items():
            folder.joinpath(name + ".txt").write_text("\n".join([*lines, ""]), encoding="utf-8")
    else:
        contents_binary = _binary_files(cameras, images, xyz, rgb, tracks)
        for name, records in contents_binary.items():
            data = _COUNT.pack(len(records)) + b"".join(records)
            folder.joinpath(name + ".bin").write_bytes(data)


def _binary_files(
    cameras: Mapping[int, ColmapCamera],
    images: Sequence[ColmapImage],
    xyz: np.ndarray,
    rgb: np.ndarray,
    tracks: Sequence[Sequence[tuple[int, int]]],
) -> dict[str, list[bytes]]:
    numbers = {name: number for number, (name, _) in enumerate(CAMERA_MODELS)}
    return {
        "cameras": [
            _CAMERA_HEAD.pack(key, numbers[camera.model], camera.width, camera.height)
            + struct.pack(f"<{len(camera.params)}d", *camera.params)
            for key, camera in cameras.items()
        ],
        "images": [
            _IMAGE_HEAD.pack(number, *image.pose, image.camera_id)
            + image.name.encode("utf-8", errors="surrogateescape")
            + b"\0"
            + _COUNT.pack(0)
            for number, image in enumerate(images, 1)
        ],
        "points3D": [
            struct.pack("<Q3d3BdQ", number, *position, *colour, 0.0, len(track))
            + b"".join(struct.pack("<II", *pair) for pair in track)
            for number, (position, colour, track) in enumerate(
                zip(xyz.tolist(), rgb.tolist(), tracks, strict=True), 1
            )
        ],
    }


def _text_files(
    cameras: Mapping[int, ColmapCamera],
    images: Sequence[ColmapImage],
    xyz: np.ndarray,
    rgb: np.ndarray,
    tracks: Sequence[Sequence[tuple[int, int]]],
) -> dict[str, list[str]]:
    # repr() of a float is the shortest text that reads back as the same number.
    return {
        "cameras": [
            f"# Number of cameras: {len(cameras)}",
            *(
                " ".join(map(str, (key, camera.model, camera.width, camera.height, *camera.params)))
                for key, camera in cameras.items()
            ),
        ],
        "images": [
            f"# Number of images: {len(images)}",
            *(
                " ".join(map(str, (number, *image.pose, image.camera_id, image.name)))
                + "\n"  # the line of observations, empty
                for number, image in enumerate(images, 1)
            ),
        ],
        "points3D": [
            f"# Number of points: {len(xyz)}",
            *(
                " ".join(map(str, (number, *position, *colour, 0.0, *sum(track, ()))))
                for number, (position, colour, track) in enumerate(
                    zip(xyz.tolist(), rgb.tolist(), tracks, strict=True), 1
                )
            ),
        ],
    }
