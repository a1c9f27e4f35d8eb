"""Lists of cameras as JSON, as the reference's `cameras.json` has them.

Position and rotation are those of world_from_cam, in OpenCV axes; sizes and focal lengths are in
pixels. The principal point is not in it: it is taken as the middle of the picture.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import quat_from_rotation, rotation_from_quat
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_json
from snowsplat.util.safe_json import read_json

_LARGEST = 100_000  # pixels along a side
# What single precision can still reckon with: focal lengths in pixels, world units.
_LEAST_FOCAL, _MOST_FOCAL, _FARTHEST = 1e-3, 1e9, 1e15


def write_cameras(path: Path, cameras: Iterable[tuple[str, Camera]]) -> None:
    """Write names and cameras, atomically."""
    write_json(path, entries_of(cameras))


def entries_of(cameras: Iterable[tuple[str, Camera]]) -> list[dict[str, Any]]:
    """What stands in such a file: JSON values."""
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
            }
        )
    return entries


def read_cameras(path: Path) -> tuple[list[str], list[Camera]]:
    """Names and cameras, in the order of the file.

    Raises:
        UserError: absent, damaged, or none in it.
    """
    try:
        entries = read_json(path)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; name a list of cameras (JSON)") from None
    except (ValueError, OSError):
        raise UserError(f"{path}: cannot be read as JSON; name a list of cameras") from None
    if not isinstance(entries, list) or not entries:
        raise UserError(f"{path}: is no list of cameras; it should be as an OUT/cameras.json is")
    names, cameras = [], []
    for i, entry in enumerate(entries):
        try:
            cameras.append(_camera(entry))
            names.append(str(entry.get("img_name", i)))
        except (KeyError, TypeError, ValueError, OverflowError, RuntimeError):
            raise UserError(
                f"{path}: camera {i} is damaged; it needs width, height, fx, fy, position and "
                "rotation, as in an OUT/cameras.json"
            ) from None
    return names, cameras


def _camera(entry: dict[str, Any]) -> Camera:
    width, height = int(entry["width"]), int(entry["height"])
    position = torch.tensor(entry["position"], dtype=torch.float64).reshape(3)
    rotation = torch.tensor(entry["rotation"], dtype=torch.float64).reshape(3, 3)
    error = rotation @ rotation.T - torch.eye(3, dtype=torch.float64)
    is_one = float(error.abs().max()) < 1e-3 and float(torch.linalg.det(rotation)) > 0
    fx, fy = float(entry["fx"]), float(entry["fy"])
    if not (is_one and float(position.abs().max()) < _FARTHEST):
        raise ValueError("not a rotation, or absurdly far")
    if not (min(fx, fy) >= _LEAST_FOCAL and max(fx, fy) <= _MOST_FOCAL):
        raise ValueError("no focal lengths")
    if max(width, height) > _LARGEST:
        raise ValueError("too large")
    rotation = rotation_from_quat(quat_from_rotation(rotation))  # exactly one, from rounded numbers
    pose = torch.cat([rotation.T, -(rotation.T @ position)[:, None]], 1)
    return Camera(width, height, fx, fy, width / 2, height / 2, pose)
