"""Which Gaussians are in a globe, and where."""

import math

import pytest
import torch

from snowsplat.extras.globe.dimensions import FLOOR, FLOOR_RADIUS
from snowsplat.extras.globe.layout import arrange
from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import transform
from snowsplat.scene.gaussians import SH_C0, Gaussians
from snowsplat.scene.geometry import Similarity, look_at
from snowsplat.util.errors import UserError

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


def gaussians(means: torch.Tensor, scales: tuple[float, float, float], red: float) -> Gaussians:
    n = len(means)
    return Gaussians(
        means.float(),
        torch.tensor(scales).log().repeat(n, 1),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        torch.full((n,), 3.0),
        torch.full((n, 1, 3), (red - 0.5) / SH_C0),
        torch.zeros(n, 0, 3),
    )


def table() -> Gaussians:
    """A table top (black) at y = 0 with a tower (white) on it; a leg and a floor (grey) below."""
    random = torch.Generator().manual_seed(0)

    def box(n: int, low: tuple[float, ...], high: tuple[float, ...]) -> torch.Tensor:
        low, high = torch.tensor(low), torch.tensor(high)
        return low + (high - low) * torch.rand(n, 3, generator=random)

    top = gaussians(box(3000, (-1, 0, -1), (1, 0.005, 1)), (0.03, 0.001, 0.03), 0.0)
    tower = gaussians(box(800, (-0.2, -0.8, -0.2), (0.2, 0, 0.2)), (0.02, 0.02, 0.02), 1.0)
    leg = gaussians(box(500, (-0.1, 0.1, -0.1), (0.1, 1, 0.1)), (0.02, 0.02, 0.02), 0.5)
    ground = gaussians(box(3000, (-4, 1, -4), (4, 1.01, 4)), (0.05, 0.001, 0.05), 0.5)
    floater = gaussians(torch.tensor([[0.1, -0.95, 0.5]]), (0.01, 0.01, 0.01), 0.7)
    return Gaussians.cat([top, tower, leg, ground, floater])


def cameras(sector: float = 2 * math.pi) -> list[Camera]:
    """Cameras at a distance of 2.6 that look at the tower."""
    target = torch.tensor([0.0, -0.3, 0.0], dtype=torch.float64)
    found = []
    for i in range(12):
        angle = sector * i / 12
        position = torch.tensor([2.4 * math.sin(angle), -1.2, -2.4 * math.cos(angle)]).double()
        pose = look_at(position, target, UP)
        found.append(Camera(200, 150, 180.0, 180.0, 100.0, 75.0, pose))
    return found


def test_the_subject_stands_on_the_floor_of_the_globe():
    result = arrange(table(), cameras(), 100_000)
    inside = result.gaussians
    red = inside.base_colors[:, 0]
    top, tower = inside.means[red < 0.1], inside.means[red > 0.9]
    # The table top is the floor; the tower stands on it, upright, in the middle.
    assert (top[:, 1] - FLOOR).abs().max() < 0.02
    assert 0.7 * FLOOR_RADIUS < top[:, ::2].norm(dim=1).max() < FLOOR_RADIUS
    assert len(tower) == 800
    assert tower[:, 1].max() < FLOOR + 0.02
    assert tower[:, 1].min() < FLOOR - 0.5
    assert tower[:, ::2].abs().mean() < 0.2
    # Neither what is below the table, nor the isolated Gaussian is in the globe.
    assert ((red < 0.1) | (red > 0.9)).all()
    assert inside.means.norm(dim=1).max() < 0.97
    assert result.surrounded
    assert not arrange(table(), cameras(math.pi), 100).surrounded


def test_the_frame_of_the_scene_has_no_effect():
    """The scene is tilted, moved and scaled, as COLMAP leaves it."""
    half = math.radians(25)
    cos, sin = math.cos(half), math.sin(half)
    tilt = torch.tensor([[1, 0, 0], [0, cos, -sin], [0, sin, cos]], dtype=torch.float64)
    change = Similarity(7.0, tilt, torch.tensor([3.0, -5.0, 20.0]))
    moved = [
        Camera(c.width, c.height, c.fx, c.fy, c.cx, c.cy, change.apply_to_poses(c.cam_from_world))
        for c in cameras()
    ]
    plain = arrange(table(), cameras(), 100_000).gaussians
    tilted = arrange(transform(table(), change), moved, 100_000).gaussians
    assert len(plain) == len(tilted)
    order, other = plain.means[:, 0].argsort(), tilted.means[:, 0].argsort()
    assert torch.allclose(plain.means[order], tilted.means[other], atol=2e-3)
    assert torch.allclose(plain.log_scales.sum(), tilted.log_scales.sum(), rtol=1e-3)


def test_unusual_cameras():
    down = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 3.0]], dtype=torch.float64)
    above = Camera(200, 150, 180.0, 180.0, 100.0, 75.0, down)  # at y = -3, looks down
    assert above.position.tolist() == [0, -3, 0]
    result = arrange(table(), [above], 100_000)
    assert result.gaussians.means[:, 1].max() < FLOOR + 0.05
    assert len(result.gaussians) > 2000
    assert not result.surrounded
    # All cameras are at one point and look outwards; nothing is there.
    outwards = []
    for i in range(8):
        target = torch.tensor([math.sin(i * math.pi / 4), -2.0, math.cos(i * math.pi / 4)]).double()
        pose = look_at(torch.tensor([0.0, -2.0, 0.0]).double(), target, UP)
        outwards.append(Camera(200, 150, 180.0, 180.0, 100.0, 75.0, pose))
    with pytest.raises(UserError, match="no Gaussians are left"):
        arrange(table(), outwards, 100)


def test_a_file_without_cameras():
    result = arrange(table().select(torch.arange(3800)), [], 100_000)
    assert result.surrounded
    red = result.gaussians.base_colors[:, 0]
    tower = result.gaussians.means[red > 0.9]
    assert len(tower) > 700
    assert abs(tower[:, 1].max() - FLOOR) < 0.05
    assert tower[:, 1].min() < FLOOR - 0.3


def test_many_gaussians_are_merged():
    result = arrange(table(), cameras(), 1500).gaussians
    assert len(result) == 1500
    importance = result.opacities.log() + result.log_scales.amax(1)
    assert (importance.diff() <= 1e-6).all()


def test_scenes_that_cannot_be_arranged():
    with pytest.raises(UserError, match="no visible Gaussians"):
        arrange(table().select(torch.zeros(0).long()), cameras(), 100)
    damaged = table()
    damaged.means[:] = float("nan")
    with pytest.raises(UserError, match="no visible Gaussians"):
        arrange(damaged, [], 100)
    away = table()
    away.means += 1000.0
    with pytest.raises(UserError, match="no Gaussians are left"):
        arrange(away, cameras(), 100)
