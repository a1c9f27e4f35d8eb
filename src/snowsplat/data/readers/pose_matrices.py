"""Poses as matrices in text files: the layouts of SLAM and depth cameras in `LAYOUTS`.

Unless the table says otherwise, poses are world_from_cam in metres, of cameras with OpenCV axes:

- ScanNet (github.com/ScanNet/ScanNet, SensReader): ``pose/0.txt`` of ``color/0.jpg``, with infinite
  numbers where tracking was lost; ``depth/0.png`` in millimetres.
- NSVF (github.com/facebookresearch/NSVF): ``pose/0_0001.txt`` of ``rgb/0_0001.png``; 0 is for
  training.
- TUM RGB-D (its page File Formats): a line of ``groundtruth.txt`` has a time, a position, and a
  quaternion x y z w; photos in ``rgb`` are named by times; depth maps have 5000 per metre.
- Replica, rendered for NICE-SLAM: a line of ``traj.txt`` is the matrix of
  ``results/frame000000.jpg``; ``cam_params.json`` has the camera and the unit of depth maps.
- 3d Scanner App: ``frame_00000.json`` has K and a matrix of ARKit, by rows, of a camera with y up
  that looks along −z; ``depth_00000.png`` is in millimetres, ``conf_00000.png`` 0 where it is low.

Where nothing tells the camera, ``intrinsics.txt`` may: fx fy cx cy in pixels, which k1 k2 p1 p2 of
OpenCV may follow, or K.
"""

from __future__ import annotations

import contextlib
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import Intrinsics
from snowsplat.data.readers.pose_layout import TRIED, Frame, Layout, floats
from snowsplat.data.readers.reconstruction import PhotoFolder
from snowsplat.util.messages import Message, message
from snowsplat.util.natural_order import natural_key
from snowsplat.util.safe_json import is_file, quoted

_Value = TypeVar("_Value")

_INTRINSICS = "intrinsics.txt"
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


def _intrinsics(k: np.ndarray) -> Intrinsics:
    """From K (3, 3) or more."""
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
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
    Layout("TUM", "groundtruth.txt", "", _NUMBERS, _tum, _tum_lens, lambda path: 1 / 5000),
    Layout("Replica", "traj*.txt", "", _NUMBERS, _replica, _replica_lens, _replica_unit),
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
