"""A drawing of given cameras from above, whatever direction is up in their world."""

import re

import numpy as np
import pytest
import torch

from snowsplat.data.points_ply import write_points
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.scene.camera import Camera
from snowsplat.scene.camera_json import write_cameras
from snowsplat.scene.geometry import look_at
from snowsplat.studio.recorder import cameras_from_above
from snowsplat.util.errors import UserError


def drawn(folder, up_axis: int, with_points: bool) -> str:
    """A ring of 12 cameras around points, on a level plane."""
    up = torch.eye(3, dtype=torch.float64)[up_axis]
    level = [torch.eye(3, dtype=torch.float64)[(up_axis + k) % 3] for k in (1, 2)]
    angles = torch.arange(12) * (2 * torch.pi / 12)
    eyes = [4 * (level[0] * a.cos() + level[1] * a.sin()) + 0.5 * up for a in angles.double()]
    poses = [look_at(eye, torch.zeros(3, dtype=torch.float64), up) for eye in eyes]
    cameras = [(f"{i}", Camera(60, 40, 50.0, 50.0, 30.0, 20.0, p)) for i, p in enumerate(poses)]
    folder.mkdir()
    write_cameras(folder / "cameras.json", cameras)
    if with_points:
        xyz = np.random.default_rng(0).uniform(-1, 1, (50, 3)).astype(np.float32)
        write_points(folder / "input.ply", xyz, np.full((50, 3), 128, np.uint8))
    return cameras_from_above(TrainingFolder(folder))


@pytest.mark.parametrize("up_axis", [0, 1, 2])
def test_a_ring_is_drawn_as_a_ring(tmp_path, up_axis):
    """From the side, it would be a line."""
    svg = drawn(tmp_path / "out", up_axis, with_points=False)
    numbers = [float(n) for n in re.search(r'viewBox="([^"]+)"', svg)[1].split()]
    assert 0.8 < numbers[2] / numbers[3] < 1.25
    assert svg.count("<title>") >= 12
    assert len(drawn(tmp_path / "points", up_axis, with_points=True)) > len(svg)


def test_a_folder_without_cameras(tmp_path):
    with pytest.raises(UserError, match=r"cameras\.json"):
        cameras_from_above(TrainingFolder(tmp_path))
