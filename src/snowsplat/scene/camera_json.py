"""Camera lists in the JSON format of `cameras.json`, as 3D Gaussian Splatting programs use it.

Position and rotation are the parts of world_from_cam, in OpenCV axes. Sizes and focal lengths are
in pixels. The format does not store the principal point; readers use the middle of the image.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from snowsplat.scene.camera import NEAR, Camera
from snowsplat.scene.geometry import quat_from_rotation, rotation_from_quat
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_json
from snowsplat.util.safe_json import read_json

# Largest width or height in pixels.
_MAX_SIDE = 100_000
# Limits of focal lengths in pixels and of coordinates in world units. Computations in float32 are
# finite within these limits.
_MIN_FOCAL = 1e-3
_MAX_FOCAL = 1e9
_MAX_COORDINATE = 1e15


def write_cameras(path: Path, cameras: Iterable[tuple[str, Camera]]) -> None:
    """Write names and cameras atomically.

    Raises:
        OSError: the folder is missing or not writable, or the disk is full.
    """
    write_json(path, entries_of(cameras))


def entries_of(cameras: Iterable[tuple[str, Camera]]) -> list[dict[str, Any]]:
    """The JSON values of a camera list."""
    entries = []
    for i, (name, camera) in enumerate(cameras):
        pose = camera.world_from_cam.detach()
        entries.append(
            {
                "id": i,
                "img_name": name,
                "width": camera.width,
                "height": camera.height,
                "position": pose[:, 3].tolist(),
                "rotation": pose[:, :3].tolist(),
                "fy": camera.fy,
                "fx": camera.fx,
                "near": camera.near,
            }
        )
    return entries


def read_cameras(path: Path) -> tuple[list[str], list[Camera]]:
    """Read names and cameras, in the order of the file.

    Raises:
        UserError: the file is missing, damaged, or has no cameras.
    """
    try:
        entries = read_json(path)
    except FileNotFoundError:
        raise UserError("{path}: no such file; use a camera list (JSON)", path=path) from None
    except (ValueError, OSError):
        raise UserError("{path}: cannot be read as JSON; use a camera list", path=path) from None
    if not isinstance(entries, list) or not entries:
        raise UserError("{path}: not a camera list; expected the format of cameras.json", path=path)
    names, cameras = [], []
    for i, entry in enumerate(entries):
        try:
            cameras.append(_camera(entry))
            names.append(str(entry.get("img_name", i)))
        except (KeyError, TypeError, ValueError, OverflowError, RuntimeError):
            raise UserError(
                "{path}: camera {i} is damaged; it needs width, height, fx, fy, position and "
                "rotation, in the format of cameras.json",
                path=path,
                i=i,
            ) from None
    return names, cameras


def read_speeds(path: Path) -> list[float]:
    """The speed of a film at each camera of a list that `read_cameras` has read, relative to the
    others: the field "speed", 1 if there is none.

    Raises:
        UserError: a speed is no number, or not between 1e-6 and 1e6.
    """
    speeds = [entry.get("speed", 1.0) for entry in read_json(path)]
    for i, speed in enumerate(speeds):
        is_number = isinstance(speed, int | float) and not isinstance(speed, bool)
        if not (is_number and 1e-6 < speed < 1e6):
            raise UserError(
                "{path}: camera {i}: its speed is not between 1e-6 and 1e6; use 1", path=path, i=i
            )
    return speeds


def _camera(entry: dict[str, Any]) -> Camera:
    width, height = int(entry["width"]), int(entry["height"])
    position = torch.tensor(entry["position"], dtype=torch.float64).reshape(3)
    rotation = torch.tensor(entry["rotation"], dtype=torch.float64).reshape(3, 3)
    error = rotation @ rotation.T - torch.eye(3, dtype=torch.float64)
    is_rotation = float(error.abs().max()) < 1e-3 and float(torch.linalg.det(rotation)) > 0
    fx, fy = float(entry["fx"]), float(entry["fy"])
    if not (is_rotation and float(position.abs().max()) < _MAX_COORDINATE):
        raise ValueError("not a rotation, or a position too far away")
    if not (min(fx, fy) >= _MIN_FOCAL and max(fx, fy) <= _MAX_FOCAL):
        raise ValueError("invalid focal lengths")
    if max(width, height) > _MAX_SIDE:
        raise ValueError("too large")
    # The file has rounded numbers; this makes the matrix exactly orthonormal.
    rotation = rotation_from_quat(quat_from_rotation(rotation))
    pose = torch.cat([rotation.T, -(rotation.T @ position)[:, None]], 1)
    near = float(entry.get("near", NEAR))  # other programs do not write it
    return Camera(width, height, fx, fy, width / 2, height / 2, pose, near)
