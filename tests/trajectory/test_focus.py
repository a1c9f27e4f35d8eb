"""Viewing distance, focus, and cameras with other image sizes."""

import math

import pytest
import torch

from snowsplat.trajectory.focus import focus_of, resized, viewing_distance

from .rigs import FOCUS, camera_at, ring, wall


def test_viewing_distance_counts_visible_points():
    cameras = ring(20, 4.0, 4.0)
    random = torch.Generator().manual_seed(0)
    thing = FOCUS.float() + 0.1 * torch.randn(500, 3, generator=random)
    behind = torch.tensor([[0.0, -1000.0, 0.0]]).expand(400, 3)
    expected = math.hypot(4.0, 1.0)
    assert viewing_distance(cameras, torch.cat([thing, behind])) == pytest.approx(expected, abs=0.1)
    assert viewing_distance(cameras, behind) == pytest.approx(1000, rel=0.01)  # none is visible
    assert viewing_distance(cameras, torch.zeros(0, 3)) == 1.0


def test_focus_of_parallel_and_outward_cameras():
    torch.testing.assert_close(
        focus_of(wall(), 5.0), torch.tensor([0.5, 0.225, 5.0], dtype=torch.float64)
    )
    outward = [
        camera_at(
            (math.cos(t), 0.0, math.sin(t)),
            torch.tensor([9 * math.cos(t), 0, 9 * math.sin(t)]).double(),
        )
        for t in torch.arange(12).mul(math.pi / 6).tolist()
    ]
    assert float(focus_of(outward, 5.0).norm()) < 1e-6


def test_resized_cameras_have_square_pixels_and_the_same_area_of_view():
    camera = ring(1)[0]
    same = resized(camera, 128, 96)
    assert (same.fx, same.fy, same.cx, same.cy) == (120.0, 120.0, 64.0, 48.0)
    wide = resized(camera, 160, 90)
    assert wide.fx == wide.fy
    field, before = 160 * 90 / wide.fx**2, 64 * 48 / 60.0**2
    assert field == pytest.approx(before)
    torch.testing.assert_close(wide.cam_from_world, camera.cam_from_world)
