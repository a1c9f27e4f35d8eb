"""Camera lists: round trip, and invalid files."""

import json

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import read_cameras, write_cameras
from snowsplat.scene.geometry import look_at
from snowsplat.util.errors import UserError


def camera(x: float) -> Camera:
    position = torch.tensor([x, 1.0, -3.0], dtype=torch.float64)
    up = torch.tensor([0.0, -1.0, 0.1], dtype=torch.float64)
    return Camera(64, 48, 55.0, 56.0, 32.0, 24.0, look_at(position, 0 * up, up))


def test_round_trip(tmp_path):
    cameras = [camera(0.0), camera(2.5)]
    write_cameras(tmp_path / "list.json", [("a", cameras[0]), ("b <c>", cameras[1])])
    names, read = read_cameras(tmp_path / "list.json")
    assert names == ["a", "b <c>"]
    for one, other in zip(read, cameras, strict=True):
        assert (one.width, one.height, one.fx, one.fy) == (64, 48, 55.0, 56.0)
        torch.testing.assert_close(one.cam_from_world, other.cam_from_world)


def test_invalid_lists_are_rejected(tmp_path):
    path = tmp_path / "list.json"
    with pytest.raises(UserError, match="no such file"):
        read_cameras(path)
    path.write_bytes(b"\xff{")
    with pytest.raises(UserError, match="cannot be read as JSON"):
        read_cameras(path)
    for content in ("{}", "[]", "3"):
        path.write_text(content)
        with pytest.raises(UserError, match="not a camera list"):
            read_cameras(path)
    write_cameras(path, [("a", camera(0.0))])
    whole = json.loads(path.read_text())[0]
    for change in (
        {"width": 0},
        {"width": "x"},
        {"width": 10**9},
        {"fx": -1.0},
        {"fy": float("inf")},
        {"fx": 1e-300, "fy": 1e300},
        {"position": [1e300, 0, 0]},
        {"position": [1, 2]},
        {"position": [1, 2, float("nan")]},
        {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]},
        {"rotation": 7},
        {"rotation": [[1, 0], [0, 1, 2], 0]},
    ):
        path.write_text(json.dumps([whole, whole | change]))
        with pytest.raises(UserError, match="camera 1 is damaged"):
            read_cameras(path)
    for entry in (3, None, []):
        path.write_text(json.dumps([entry]))
        with pytest.raises(UserError, match="camera 0 is damaged"):
            read_cameras(path)
