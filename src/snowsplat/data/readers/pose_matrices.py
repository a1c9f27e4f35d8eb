"""Poses as matrices in text files: the layouts of SLAM and depth cameras in `LAYOUTS`.

Unless the table says otherwise, poses are world_from_cam in metres, of cameras with OpenCV axes:

- ScanNet (github.com/ScanNet/ScanNet, SensReader): ``pose/0.txt`` of ``color/0.jpg``, with infinite
  numbers where tracking was lost; ``depth/0.png`` in millimetres.
- NSVF (github.com/facebookresearch/NSVF): ``pose/0_0001.txt`` of ``rgb/0_0001.png``; 0 is for
  training.
- KITTI odometry (its readme.txt): a line of ``poses.txt`` has the rows of a matrix of the left grey
  camera; P2 of ``calib.txt`` projects from its frame to ``image_2``.
- MVSNet (github.com/YoYo000/MVSNet): ``cams/00000000_cam.txt`` has cam_from_world and K.
- IDR and NeuS (github.com/lioryariv/idr): ``world_mat_0`` in ``cameras.npz`` is K · cam_from_world
  of the first photo in ``image``.
- TUM RGB-D (its page File Formats): a line of ``groundtruth.txt`` has a time, a position, and a
  quaternion x y z w; photos in ``rgb`` are named by times; depth maps have 5000 per metre.
- Replica, rendered for NICE-SLAM: a line of ``traj.txt`` is the matrix of
  ``results/frame000000.jpg``; ``cam_params.json`` has the camera and the unit of depth maps.
- Tanks and Temples (its tutorial): ``*.log`` has matrices of the photos, sorted by name.
- 7-Scenes (its README): ``frame-000000.pose.txt`` of ``frame-000000.color.png``;
  ``frame-000000.depth.png`` is in millimetres.
- 3d Scanner App: ``frame_00000.json`` has K and a matrix of ARKit, by rows, of a camera with y up
  that looks along −z; ``depth_00000.png`` is in millimetres, ``conf_00000.png`` 0 where it is low.

Where nothing tells the camera, ``intrinsics.txt`` may: fx fy cx cy in pixels, which k1 k2 p1 p2 of
OpenCV may follow, or K.
"""

import contextlib
import io
import zipfile
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from snowsplat.data.files.photo_files import photos_below
from snowsplat.data.photos.image_file import reason_of
from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import Intrinsics
from snowsplat.data.readers.pose_layout import TRIED, Frame, Layout, floats
from snowsplat.data.readers.reconstruction import PhotoFolder
from snowsplat.util.errors import Problem, UserError
from snowsplat.util.messages import Message, message
from snowsplat.util.natural_order import natural_key
from snowsplat.util.safe_json import is_file, quoted

_Value = TypeVar("_Value")

_INTRINSICS = "intrinsics.txt"
# Largest member of cameras.npz in bytes: a matrix of 16 numbers, and its header.
_MOST_BYTES = 1024
# Seconds between a photo and its pose at most: the limit of associate.py of TUM RGB-D.
_SECONDS = 0.02
# fx, fy, cx, cy, k1, k2, p1, p2, k3 of the three cameras of TUM RGB-D, from its page File Formats.
# Its centre of the first pixel is (0, 0).
_FREIBURG = {
    "freiburg1": (517.3, 516.5, 319.1, 255.8, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    "freiburg2": (520.9, 521.0, 325.6, 250.2, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    "freiburg3": (535.4, 539.2, 320.6, 248.1),
}


def _lines(path: Path) -> list[str]:
    """The lines that are neither empty nor comments."""
    lines = (line.strip() for line in parse.load_text(path).splitlines())
    return [line for line in lines if line and not line.startswith("#")]


def _intrinsics(k: np.ndarray, first_pixel: float = 0.0) -> Intrinsics:
    """From K (3, 3) or more; ``first_pixel``: what is added, if its centre is 0 there."""
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2] + first_pixel, k[1, 2] + first_pixel
    return float(fx), float(fy), float(cx), float(cy)


def _lens_of(path: Path) -> Sequence[float] | None:
    """The camera in a text file: K as 3 or 4 rows; fx fy cx cy …; or f cx cy 0 as NSVF has it."""
    if not is_file(path):
        return None
    lines = [*_lines(path), ""]
    first, rows = floats(path, lines[0]), floats(path, " ".join(lines[:4]))
    # K in one line has 0 where fy would be.
    rows = first if len(first) in (9, 16) and first[1] == 0 else rows
    if (len(first), len(rows)) in ((3, 9), (4, 16), (9, 9), (16, 16)) and rows[1] == 0:
        return _intrinsics(parse.numbers(path, rows, len(rows)).reshape(-1, 3 + (len(rows) > 9)))
    if not 4 <= len(first) <= 9:
        raise parse.damaged(path, "should have fx fy cx cy, or a matrix of 3 or 4 rows")
    values: list[float] = parse.numbers(path, first, len(first)).tolist()
    return [values[0], *values[:3]] if len(values) == 4 and values[3] == 0 else values


def _lens_beside(path: Path) -> Sequence[float] | None:
    return _lens_of(path.parent / _INTRINSICS)


def _own_lens(path: Path) -> Sequence[float] | None:
    return ()  # each frame has one


def _scannet(path: Path, photos: PhotoFolder) -> Iterator[Frame]:
    for file in sorted(path.glob("*.txt"), key=lambda file: natural_key(file.name)):
        yield Frame(f"color/{file.stem}", file, path.parent / "depth" / f"{file.stem}.png")


def _scannet_lens(path: Path) -> Sequence[float] | None:
    if not (path.parent / "color").is_dir():
        return None
    return _lens_of(path.parent / "intrinsic" / "intrinsic_color.txt") or _lens_beside(path)


def _nsvf(path: Path, photos: PhotoFolder) -> Iterator[Frame]:
    files = sorted(path.glob("*.txt"))
    prefixes = {file.stem.partition("_")[0] for file in files}
    parted = {"0"} < prefixes <= {"0", "1", "2"}
    for file in files:
        split: Literal["train", "test"] = "train" if file.stem.startswith("0_") else "test"
        yield Frame(f"rgb/{file.stem}", file, split=split if parted else None)


def _kitti_projection(path: Path) -> tuple[str, np.ndarray] | None:
    """The folder of photos, colours first, and (3, 4) the projection to them from the frame of the
    left grey camera."""
    names = ("image_2", "image_3", "image_0", "image_1")
    folder = next((name for name in names if (path.parent / name).is_dir()), None)
    calibration = path.with_name("calib.txt")
    if folder is not None and is_file(calibration):
        for line in _lines(calibration):
            name, _, values = line.partition(":")
            if name == f"P{folder[-1]}":
                return folder, parse.numbers(calibration, values.split(), 12).reshape(3, 4)
    return None


def _kitti(path: Path, photos: PhotoFolder) -> Iterator[Frame]:
    folder, projection = _kitti_projection(path) or ("", np.eye(4)[:3])
    shift = np.eye(4)
    shift[:3, 3] = -np.linalg.pinv(projection[:, :3]) @ projection[:, 3]

    def camera(line: str) -> tuple[np.ndarray, None]:
        return (parse.numbers(path, line.split(), 12).reshape(3, 4) @ shift).ravel(), None

    for index, line in enumerate(_lines(path)):
        yield Frame(f"{folder}/{index:06d}", partial(camera, line))


def _kitti_lens(path: Path) -> Sequence[float] | None:
    found = _kitti_projection(path)
    return None if found is None else _intrinsics(found[1], 0.5)


def _mvsnet(path: Path, photos: PhotoFolder) -> Iterator[Frame]:
    blended = "blended_images" if (path.parent / "blended_images").is_dir() else "images"
    for file in sorted(path.glob("*_cam.txt")):
        stem = file.stem.removesuffix("_cam")
        yield Frame(f"{blended}/{stem}", partial(_mvsnet_camera, file))


def _mvsnet_camera(file: Path) -> tuple[np.ndarray, Intrinsics]:
    text = parse.load_text(file)
    pose, k = (
        parse.numbers(file, text.partition(word)[2].split()[:count], count)
        for word, count in (("extrinsic", 16), ("intrinsic", 9))
    )
    return pose, _intrinsics(k.reshape(3, 3))


def _idr(path: Path, photos: PhotoFolder) -> Iterator[Frame]:
    folder = next((n for n in ("image", "images", "rgb") if (path.parent / n).is_dir()), ".")
    for index, file in enumerate(photos_below(path.parent / folder)):
        yield Frame(f"{folder}/{file}", partial(_idr_camera, path, index))


def _idr_camera(path: Path, index: int) -> tuple[np.ndarray, Intrinsics]:
    """From K · cam_from_world of a photo, up to its scale."""
    try:
        with zipfile.ZipFile(path) as archive:
            info = archive.getinfo(f"world_mat_{index}.npy")
            data = io.BytesIO(archive.read(info) if info.file_size <= _MOST_BYTES else b"")
        version = np.lib.format.read_magic(data)
        shape, by_columns, dtype = np.lib.format.read_array_header_1_0(data)
        if version != (1, 0) or shape != (4, 4) or dtype.kind != "f":
            raise Problem("it has the shape {shape}", shape=shape)
        rows = np.frombuffer(data.read(), dtype).reshape(shape, order="F" if by_columns else "C")
        projection = parse.numbers(path, rows[:3], 3, 4)
        # M = K R: the QR decomposition of the transpose of M, with its rows in reverse order.
        m = projection[:, :3] * np.sign(np.linalg.det(projection[:, :3]))
        q, r = np.linalg.qr(m[::-1].T)
        k, rotation = r.T[::-1, ::-1], q.T[::-1]
        signs = np.sign(np.diag(k))
        k, rotation = k * signs / abs(k[2, 2]), signs[:, None] * rotation
        centre = -np.linalg.solve(projection[:, :3], projection[:, 3])
    except Exception as error:  # zipfile, zlib and numpy raise many kinds
        text = message("world_mat_{n} cannot be read ({error})", n=index, error=reason_of(error))
        raise parse.damaged(path, text) from None
    # IDR counts pixels from the centre of the first one.
    return np.column_stack([rotation.T, centre]).ravel(), _intrinsics(k, 0.5)


def _tum_lens(path: Path) -> Sequence[float] | None:
    name = str(path.absolute().parent).lower()
    known = next((lens for camera, lens in _FREIBURG.items() if camera in name), None)
    return _lens_beside(path) or known


def _tum(path: Path, photos: PhotoFolder) -> Iterator[Frame]:
    rows = (line.partition(" ") for line in _lines(path))
    poses = sorted((float(floats(path, time)[0]), pose) for time, _, pose in rows)
    depths = _tum_times(path.parent / "depth")
    for time, file in _tum_times(path.parent / "rgb"):
        if (pose := _nearest(poses, time)) is not None:
            yield Frame(f"rgb/{file.name}", pose, _nearest(depths, time))


def _tum_times(folder: Path) -> list[tuple[float, Path]]:
    """The images of a folder whose names are times in seconds, sorted."""
    found = []
    for file in folder.glob("*.png"):
        with contextlib.suppress(ValueError):
            found.append((float(file.stem), file))
    return sorted(found)


def _nearest(values: Sequence[tuple[float, _Value]], time: float) -> _Value | None:
    """The value nearest in time; None if none is near. ``values``: sorted by time."""
    at = bisect_left(values, time, key=itemgetter(0))
    around = [each for each in values[max(0, at - 1) : at + 1] if abs(each[0] - time) <= _SECONDS]
    return min(around, key=lambda each: abs(each[0] - time))[1] if around else None


def _replica_camera(path: Path) -> dict[str, Any]:
    files = (path.parent / "cam_params.json", path.parent.parent / "cam_params.json")
    file = next(filter(is_file, files), None)
    return parse.table(file, parse.table(file, parse.load_json(file)).get("camera")) if file else {}


def _replica_lens(path: Path) -> Sequence[float] | None:
    if camera := _replica_camera(path):
        return [parse.number(path, camera, key) for key in ("fx", "fy", "cx", "cy")]
    return _lens_beside(path)


def _replica_unit(path: Path) -> float:
    return 1.0 / max(parse.number(path, _replica_camera(path), "scale", 1.0), 1e-6)


def _replica(path: Path, photos: PhotoFolder) -> Iterator[Frame]:
    for index, line in enumerate(_lines(path)):
        depth = path.parent / "results" / f"depth{index:06d}.png"
        yield Frame(f"results/frame{index:06d}", line, depth)


def _log(path: Path, photos: PhotoFolder) -> Iterator[Frame]:
    lines, files = _lines(path), photos_below(photos.root)
    if len(lines) != 5 * len(files):
        raise UserError(
            "{path}: has {rows} poses, but there are {files} photos in {root}; use exactly the "
            "photos that the poses were estimated from",
            path=path,
            rows=len(lines) // 5,
            files=len(files),
            root=photos.root,
        )
    for index, file in enumerate(files):
        yield Frame(file, " ".join(lines[5 * index + 1 : 5 * index + 5]))


def _seven_scenes(path: Path, photos: PhotoFolder) -> Iterator[Frame]:
    for file in sorted(path.parent.glob("*.pose.txt")):
        stem = file.name.removesuffix(".pose.txt")
        yield Frame(f"{stem}.color", file, file.with_name(f"{stem}.depth.png"))


def _scanner(path: Path, photos: PhotoFolder) -> Iterator[Frame]:
    for file in sorted(path.parent.glob("frame_*.json")):
        depth, confidence = (
            path.with_name(f"{kind}_{file.stem.removeprefix('frame_')}.png")
            for kind in ("depth", "conf")
        )
        yield Frame(file.stem, partial(_scanner_camera, file), depth, confidence)


def _scanner_camera(file: Path) -> tuple[np.ndarray, Intrinsics]:
    values = parse.table(file, parse.load_json(file))
    k = parse.numbers(file, values.get("intrinsics"), 9).reshape(3, 3)
    return parse.numbers(file, values.get("cameraPoseARFrame"), 16), _intrinsics(k)


def _millimetres(path: Path) -> float:
    return 1e-3


_NUMBERS = rb"(?:#[^\n]*\n)*\s*(?:[-+.\deEinfa]+\s+){3}"
_AR_FRAME = rb'(?s).*"cameraPoseARFrame"'

LAYOUTS = (
    Layout("ScanNet", "pose", "*.txt", _NUMBERS, _scannet, _scannet_lens, _millimetres),
    Layout("NSVF", "pose", "*.txt", _NUMBERS, _nsvf, _lens_beside, metric=False),
    Layout("KITTI", "poses.txt", "", _NUMBERS, _kitti, _kitti_lens),
    Layout(
        "MVSNet", "cams", "*_cam.txt", rb"extrinsic", _mvsnet, _own_lens, inverse=True, metric=False
    ),
    Layout("IDR", "cameras*.npz", "", rb"PK", _idr, _own_lens, metric=False),
    Layout("TUM", "groundtruth.txt", "", _NUMBERS, _tum, _tum_lens, lambda path: 1 / 5000),
    Layout("Replica", "traj*.txt", "", _NUMBERS, _replica, _replica_lens, _replica_unit),
    Layout("Tanks and Temples", "*.log", "", _NUMBERS, _log, _lens_beside, metric=False),
    Layout("7-Scenes", "*.pose.txt", "", _NUMBERS, _seven_scenes, _lens_beside, _millimetres),
    Layout(
        "3d Scanner App",
        "frame_*.json",
        "",
        _AR_FRAME,
        _scanner,
        _own_lens,
        _millimetres,
        opengl=True,
    ),
)


READERS = tuple(layout.reader() for layout in LAYOUTS)


def without_camera(folder: Path) -> Message | None:
    """What to do with poses in a folder of which nothing tells the camera; None: there are none."""
    for layout in LAYOUTS:
        for path in islice(folder.glob(layout.place), TRIED):
            if layout.has_poses(path):
                return message(
                    "{file} has camera poses in the layout of {program}, but nothing tells the "
                    "camera; to use them, write fx fy cx cy in pixels to {intrinsics}",
                    file=quoted(path.name),
                    program=layout.name,
                    intrinsics=_INTRINSICS,
                )
    return None
