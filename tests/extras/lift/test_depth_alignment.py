"""Aligning the depth to points: the true scale and shift, with hidden points and noise."""

from __future__ import annotations

import pytest
import torch

from snowsplat.data.maps.depth_alignment import align
from snowsplat.scene.geometry import transform_points
from snowsplat.util.errors import UserError


def points_on(shot, count, hidden, noise):
    """World points on the surface of a photo; a share is behind it."""
    generator = torch.Generator().manual_seed(0)
    height, width = shot.depth.shape
    row = torch.randint(height, (count,), generator=generator)
    column = torch.randint(width, (count,), generator=generator)
    z = shot.depth[row, column].double()
    z *= 1 + noise * torch.randn(count, generator=generator).double()
    behind = torch.rand(count, generator=generator) < hidden
    z = torch.where(behind, z * (1.3 + torch.rand(count, generator=generator)), z)
    camera = shot.camera
    x = (column + 0.5 - camera.cx) / camera.fx * z
    y = (row + 0.5 - camera.cy) / camera.fy * z
    return transform_points(camera.world_from_cam, torch.stack([x, y, z], 1))


def test_a_factor(shots):
    shot = shots[0]
    points = points_on(shot, 400, hidden=0.4, noise=0.005)
    found = align(shot.depth * 7, points, shot.camera, with_shift=False)
    assert found.scale == pytest.approx(7, rel=0.01)
    assert found.shift == 0
    assert found.points == 400
    assert found.error < 0.1
    torch.testing.assert_close(found.apply(shot.depth * 7), shot.depth, rtol=0.02, atol=0)


def test_a_disparity_with_a_shift(shots):
    shot = shots[0]
    points = points_on(shot, 400, hidden=0.3, noise=0.005)
    relative = 1 / (3.0 / shot.depth + 0.5)
    found = align(relative, points, shot.camera, with_shift=True)
    torch.testing.assert_close(found.apply(relative), shot.depth, rtol=0.03, atol=0)
    # Without the shift, the fit is worse.
    scaled = align(relative, points, shot.camera, with_shift=False).apply(relative)
    assert float((scaled / shot.depth - 1).abs().max()) > 0.1


def test_a_map_that_contradicts_the_points(shots):
    shot = shots[0]
    points = points_on(shot, 400, hidden=0.0, noise=0.0)
    with pytest.raises(UserError, match="contradicts"):
        align(1 / shot.depth, points, shot.camera, with_shift=True)


def test_too_few_points_in_the_photo(shots):
    shot = shots[0]
    with pytest.raises(UserError, match="only 12 points"):
        align(shot.depth, points_on(shot, 12, 0, 0), shot.camera, with_shift=False)
