"""Camera lists: round trip, and invalid files."""

import json

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import read_cameras, read_speeds, write_cameras
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


def test_the_format_is_that_of_cameras_json(tmp_path):
    """Position and rotation are those of world_from_cam; the rotation is a list of rows."""
    pose = torch.tensor([[0.0, 1, 0, 4], [-1, 0, 0, 5], [0, 0, 1, 6]], dtype=torch.float64)
    one = Camera(64, 48, 55.0, 56.0, 30.0, 20.0, pose, near=0.4)
    write_cameras(tmp_path / "list.json", [("a", one), ("b", one)])
    entry = {
        "img_name": "a",
        "width": 64,
        "height": 48,
        "position": [5.0, -4.0, -6.0],
        "rotation": [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
        "fx": 55.0,
        "fy": 56.0,
        "near": 0.4,
    }
    written = json.loads((tmp_path / "list.json").read_text())
    assert written == [entry | {"id": 0}, entry | {"id": 1, "img_name": "b"}]
    # Other programs write only the pose and the sizes. The principal point is in the middle.
    del entry["img_name"], entry["near"]
    (tmp_path / "list.json").write_text(json.dumps([entry, entry]))
    names, cameras = read_cameras(tmp_path / "list.json")
    assert names == ["0", "1"]
    assert (cameras[0].cx, cameras[0].cy) == (32.0, 24.0)
    assert cameras[0].near == 0.2
    torch.testing.assert_close(cameras[0].cam_from_world, pose)


def test_the_outermost_numbers_that_are_valid(tmp_path):
    write_cameras(tmp_path / "list.json", [("a", camera(0.0))])
    whole = json.loads((tmp_path / "list.json").read_text())[0]

    def read(**change: object) -> Camera:
        (tmp_path / "list.json").write_text(json.dumps([whole | change]))
        return read_cameras(tmp_path / "list.json")[1][0]

    assert read(width=100_000).width == 100_000
    assert read(height=100_000).height == 100_000
    assert read(width="64").width == 64
    assert (read(fx=1e-3).fx, read(fy=1e9).fy) == (1e-3, 1e9)
    read(position=[-0.9e15, 0, 0])
    for change in (
        {"width": 100_001},
        {"height": 100_001},
        {"fx": 0.9e-3},
        {"fy": 1.1e9},
        {"position": [0, -1.1e15, 0]},
    ):
        with pytest.raises(UserError, match="camera 0"):
            read(**change)


def test_rounded_rotations_become_exact(tmp_path):
    write_cameras(tmp_path / "list.json", [("a", camera(2.5))])
    entry = json.loads((tmp_path / "list.json").read_text())[0]
    exact = torch.tensor(entry["rotation"], dtype=torch.float64)

    def read(error: float) -> torch.Tensor:
        rotation = (exact * (1 + error)).tolist()
        (tmp_path / "list.json").write_text(json.dumps([entry | {"rotation": rotation}]))
        return read_cameras(tmp_path / "list.json")[1][0].cam_from_world[:, :3]

    rotation = read(4e-4)  # 8e-4 in R Rᵀ
    identity = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(rotation @ rotation.T, identity, rtol=0, atol=1e-12)
    torch.testing.assert_close(rotation, exact.T, rtol=0, atol=4e-4)
    with pytest.raises(UserError, match="camera 0"):
        read(6e-4)


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


def test_speeds(tmp_path):
    file = tmp_path / "list.json"
    write_cameras(file, [("a", camera(0.0)), ("b", camera(1.0))])
    assert read_speeds(file) == [1, 1]
    entries = json.loads(file.read_text())
    file.write_text(json.dumps([entries[0] | {"speed": 0.5}, entries[1]]))
    assert read_speeds(file) == [0.5, 1]
    for wrong in (0, -1.0, "2", None, True, [1], 10**400):
        file.write_text(json.dumps([entries[0], entries[1] | {"speed": wrong}]))
        with pytest.raises(UserError, match="camera 1: its speed is not between"):
            read_speeds(file)
