"""The swing around one photo: a closed path, and all frames look at the same point."""

from __future__ import annotations

import math

import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at
from snowsplat.trajectory.orbit import swing_path


def test_a_closed_path_around_the_photo():
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    position = torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64)
    target = torch.tensor([0.5, 1.0, 4.0], dtype=torch.float64)
    photo = Camera(40, 30, 35.0, 35.0, 20.0, 15.0, look_at(position, target, up))
    frames = swing_path(photo, 5.0, 24)
    assert len(frames) == 24
    axis = photo.world_from_cam[:, 2]
    focus = position + 5 * axis
    offsets = torch.stack([frame.position for frame in frames]) - position
    torch.testing.assert_close(offsets.mean(0), torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(offsets @ axis, torch.zeros(24, dtype=torch.float64))
    steps = (offsets - offsets.roll(1, 0)).norm(dim=1)
    assert float(steps.max()) < 3 * float(steps.min())
    angles = []
    for frame in frames:
        pixel, _ = frame.project(focus[None])
        torch.testing.assert_close(pixel[0], torch.tensor([20.0, 15.0], dtype=torch.float64))
        angles.append(math.degrees(math.acos(float(frame.world_from_cam[:, 2] @ axis))))
        assert float(frame.cam_from_world[1, :3] @ photo.cam_from_world[1, :3]) > 0.99
    assert max(angles) < 4.01
    assert max(angles) > 3.9
