"""The records of a COLMAP model, and the checks that binary and text files share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from snowsplat.data.lens.lens import Lens, Model
from snowsplat.util.errors import UserError

# Width or height of a camera in pixels. A larger value means a damaged file.
_MAX_SIDE = 1_000_000
# Largest number of images, and of cameras. Each record takes about 400 bytes of memory.
_MAX_RECORDS = 200_000
#: Number of points whose tracks are read: enough for about 100 observations in each of 250 photos.
TRACKS = 4000


@dataclass(frozen=True)
class ColmapImage:
    """A registered image: its file name, its camera and its pose."""

    name: str  # relative to the image folder
    camera_id: int
    pose: tuple[float, ...]  # cam_from_world: quaternion (w, x, y, z), then translation (x, y, z)
    number: int = field(default=0, compare=False)  # the image id, in files that were read


@dataclass(frozen=True)
class ColmapModel:
    """Cameras and images of a sparse model. `read_points` reads its points."""

    folder: Path
    text: bool  # read from .txt files, not from .bin
    cameras: Mapping[int, Lens]  # by camera id; images may share one
    images: Sequence[ColmapImage]  # sorted by name
    # Image id -> frame id, of images that were taken at one time by the cameras of a rig.
    frames: Mapping[int, int] = field(default_factory=dict)


@dataclass(frozen=True)
class PointFile:
    """The 3D points of a file, and the tracks of up to `TRACKS` of them, spread over the file."""

    xyz: np.ndarray  # (P, 3) float64, world frame
    rgb: np.ndarray  # (P, 3) uint8
    ids: np.ndarray  # (P,) int64
    tracks: np.ndarray  # (N, 3) int64: row of a point, image id, index of the observation


def track_rows(pairs: Mapping[int, np.ndarray]) -> np.ndarray:
    """`PointFile.tracks` from the pairs (image id, observation index) of points, by their row."""
    rows = [np.column_stack([np.full(len(p), row), p]) for row, p in pairs.items()]
    return np.concatenate([np.empty((0, 3), np.int64), *rows]).astype(np.int64)


def damaged_model(path: Path, problem: str) -> UserError:
    """The error for a file that does not follow the format."""
    return UserError(
        "{path}: damaged: {problem}; copy the file again or run COLMAP again",
        path=path,
        problem=problem,
    )


def check_count(path: Path, kind: str, count: int) -> None:
    """Raise `UserError` if a file has too many cameras or images."""
    if count > _MAX_RECORDS:
        raise UserError(
            "{path}: more than {max_records:,} {kind}, which is not supported",
            path=path,
            max_records=_MAX_RECORDS,
            kind=kind,
        )


def checked_camera(
    path: Path, model: Model, width: int, height: int, params: tuple[float, ...]
) -> Lens:
    """A camera whose image size is plausible; otherwise raise `UserError`."""
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE):
        raise damaged_model(path, f"a camera has the size {width}x{height}")
    return Lens(model, width, height, params)
