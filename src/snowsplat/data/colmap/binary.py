"""COLMAP's binary files: cameras.bin, images.bin, points3D.bin. All numbers are little-endian.

Counts in the files are not trusted: before anything is allocated, the declared number of records
must fit into the file.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from snowsplat.data.colmap.types import (
    TRACKS,
    ColmapImage,
    PointFile,
    check_count,
    checked_camera,
    damaged_model,
    track_rows,
)
from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.models import COLMAP_MODELS
from snowsplat.util.errors import UserError
from snowsplat.util.files import reading

_COUNT = struct.Struct("<Q")
# Id, index into COLMAP_MODELS, width, height. The parameters (doubles) follow.
_CAMERA_HEAD = struct.Struct("<IiQQ")
_SMALLEST_CAMERA = _CAMERA_HEAD.size + 2 * 8
# Id, quaternion (w, x, y, z), translation, camera id. The name, ended by a zero byte, and the
# observations follow.
_IMAGE_HEAD = struct.Struct("<I4d3dI")
_SMALLEST_IMAGE = _IMAGE_HEAD.size + 1 + _COUNT.size
# Id, rig id, pose, number of sensor data. The data follow: kind and id of the sensor, image id.
_FRAME_HEAD = struct.Struct("<II7dI")
_FRAME_DATA = struct.Struct("<iIQ")
_CAMERA = 0  # the kind of sensor
# x, y and point id.
_OBSERVATION_BYTES = 24
# Id, xyz, rgb, reprojection error, track length. The track follows, 8 bytes per element.
_POINT_BYTES = 8 + 24 + 3 + 8 + 8
_TRACK_ELEMENT_BYTES = 8


class _Cursor:
    """Reads a file that starts with a record count; raises `UserError` if data is missing."""

    def __init__(self, path: Path, kind: str, least_bytes: int) -> None:
        self.path = path
        with reading(path):
            self.data = path.read_bytes()
        self.offset = 0
        (self.count,) = self.take(_COUNT)
        if self.count * least_bytes > len(self.data) - self.offset:
            raise damaged_model(path, f"it declares {self.count} {kind}, more than fit into it")

    def take(self, layout: struct.Struct) -> tuple:
        if self.offset + layout.size > len(self.data):
            raise self.truncated()
        values = layout.unpack_from(self.data, self.offset)
        self.offset += layout.size
        return values

    def take_string(self) -> str:
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise self.truncated()
        text = self.data[self.offset : end].decode("utf-8", errors="surrogateescape")
        self.offset = end + 1
        return text

    def skip(self, size: int) -> None:
        if size > len(self.data) - self.offset:
            raise self.truncated()
        self.offset += size

    def finish(self) -> None:
        surplus = len(self.data) - self.offset
        if surplus:
            raise damaged_model(self.path, f"{surplus} bytes are left over at its end")

    def truncated(self) -> UserError:
        return damaged_model(self.path, "it is truncated")


def count_images(path: Path) -> int:
    """Number of images according to the head of images.bin, limited to what the file can hold."""
    with open(path, "rb") as file:
        head = file.read(_COUNT.size)
    if len(head) < _COUNT.size:
        return 0
    return min(_COUNT.unpack(head)[0], path.stat().st_size // _SMALLEST_IMAGE)


def read_cameras(path: Path) -> dict[int, Lens]:
    """Read a cameras.bin: cameras by id.

    Raises:
        UserError: the file is unreadable or damaged, or has a camera model that is not supported.
    """
    cursor = _Cursor(path, "cameras", _SMALLEST_CAMERA)
    check_count(path, "cameras", cursor.count)
    cameras = {}
    for _ in range(cursor.count):
        camera_id, number, width, height = cursor.take(_CAMERA_HEAD)
        if not 0 <= number < len(COLMAP_MODELS):
            raise UserError(
                "{path}: unknown camera model {number}; undistort the images with the program "
                "that made it, or copy the file again if it is damaged",
                path=path,
                number=number,
            )
        model = COLMAP_MODELS[number]
        params = cursor.take(struct.Struct(f"<{len(model.parameters)}d"))
        cameras[camera_id] = checked_camera(path, model, width, height, params)
    cursor.finish()
    return cameras


def read_images(path: Path) -> list[ColmapImage]:
    """Read an images.bin, in the order of the file. Observations are skipped.

    Raises: UserError: the file is unreadable or damaged.
    """
    return [image for image, _ in _images(path)]


def read_observations(path: Path, wanted: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Read some observations of an images.bin.

    ``wanted``: (N,) int64, indices of the observations of an image, by its id.

    Returns: (N, 3) float64: x and y in pixels, and the id of the point. NaN: no such observation.

    Raises: UserError: the file is unreadable or damaged.
    """
    record = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
    found = {}
    for image, data in _images(path):
        if image.number in wanted:
            records, rows = np.frombuffer(data, record), wanted[image.number]
            values = np.full((len(rows), 3), np.nan)
            known = rows < len(records)
            chosen = records[rows[known]]
            values[known] = np.column_stack([chosen["xy"], chosen["point"]])
            found[image.number] = values
    return found


def _images(path: Path) -> Iterator[tuple[ColmapImage, memoryview]]:
    """The images of an images.bin, and the bytes of their observations."""
    cursor = _Cursor(path, "images", _SMALLEST_IMAGE)
    check_count(path, "images", cursor.count)
    data = memoryview(cursor.data)
    for _ in range(cursor.count):
        number, *pose, camera_id = cursor.take(_IMAGE_HEAD)
        name = cursor.take_string()
        (observations,) = cursor.take(_COUNT)
        start = cursor.offset
        cursor.skip(_OBSERVATION_BYTES * observations)
        yield ColmapImage(name, camera_id, tuple(pose), number), data[start : cursor.offset]
    cursor.finish()


def read_frames(path: Path) -> list[tuple[int, list[int]]]:
    """Read a frames.bin: the id of each frame and the ids of its images.

    Raises: UserError: the file is unreadable or damaged.
    """
    cursor = _Cursor(path, "frames", _FRAME_HEAD.size)
    check_count(path, "frames", cursor.count)
    frames = []
    for _ in range(cursor.count):
        number, *_, count = cursor.take(_FRAME_HEAD)
        images = []
        for _ in range(count):  # ends with the file
            kind, _, image = cursor.take(_FRAME_DATA)
            if kind == _CAMERA:
                images.append(image)
        frames.append((number, images))
    cursor.finish()
    return frames


def read_points(path: Path) -> PointFile:
    """Read a points3D.bin. Raises: UserError: the file is unreadable or damaged."""
    cursor = _Cursor(path, "points", _POINT_BYTES)
    # The length of a record is stored in the record, so a loop finds where each record starts.
    # Everything else is done for all records at once.
    data, size = cursor.data, len(cursor.data)
    starts = np.empty(cursor.count, np.int64)
    unpack = _COUNT.unpack_from
    start = _COUNT.size
    for i in range(cursor.count):
        if start + _POINT_BYTES > size:
            raise cursor.truncated()
        starts[i] = start
        track_length = unpack(data, start + _POINT_BYTES - _COUNT.size)[0]
        start += _POINT_BYTES + _TRACK_ELEMENT_BYTES * track_length
    if start > size:
        raise cursor.truncated()
    cursor.offset = start
    cursor.finish()
    # An array view with one overlapping record per byte; the records at ``starts`` are picked.
    record = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3)])
    everywhere: np.ndarray = np.ndarray(
        max(0, size - record.itemsize + 1), record, data, strides=(1,)
    )
    records = everywhere[starts]
    tracks = {}
    for row in range(0, len(starts), -(-len(starts) // TRACKS) or 1):
        track = int(starts[row]) + _POINT_BYTES
        (length,) = unpack(data, track - _COUNT.size)
        tracks[row] = np.frombuffer(data, "<u4", 2 * length, track).reshape(-1, 2)
    ids = records["id"].astype(np.int64)
    return PointFile(records["xyz"], records["rgb"], ids, track_rows(tracks))


def camera_record(number: int, camera: Lens) -> bytes:
    head = number, COLMAP_MODELS.index(camera.kind), camera.width, camera.height
    return _CAMERA_HEAD.pack(*head) + struct.pack(f"<{len(camera.params)}d", *camera.params)


def image_record(number: int, image: ColmapImage) -> bytes:
    """Of an image without observations."""
    name = image.name.encode("utf-8", errors="surrogateescape") + b"\0"
    return _IMAGE_HEAD.pack(number, *image.pose, image.camera_id) + name + _COUNT.pack(0)


def point_record(
    number: int, position: list[float], colour: list[int], track: Sequence[tuple[int, int]]
) -> bytes:
    head = struct.pack("<Q3d3BdQ", number, *position, *colour, 0.0, len(track))
    return head + b"".join(struct.pack("<II", *pair) for pair in track)


def write_records(path: Path, records: list[bytes]) -> None:
    """Write cameras.bin, images.bin or points3D.bin."""
    path.write_bytes(_COUNT.pack(len(records)) + b"".join(records))
