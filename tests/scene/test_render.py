"""`project` and `render` against the camera's own projection. For the operations see tests/ops."""

import math

import numpy as np
import pytest
import torch

from snowsplat.ops import reference
from snowsplat.scene import panorama
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.panorama import PanoramaRenderer, level_pose
from snowsplat.scene.render import RenderOutput, project, render

WIDTH = 256
POSE = torch.eye(3, 4, dtype=torch.float64)


@pytest.fixture
def camera() -> Camera:
    """No two of its numbers are equal. It looks along z and stands beside the origin."""
    pose = torch.eye(3, 4, dtype=torch.float64)
    pose[:, 3] = torch.tensor([0.3, -0.2, 4.0])
    return Camera(64, 48, 50.0, 70.0, 30.0, 26.0, pose)


@pytest.fixture
def gaussians() -> Gaussians:
    """Three nearly opaque Gaussians, far apart, whose colours depend on the direction."""
    generator = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.tensor([[0.0, 0.0, 0.0], [0.9, 0.4, 0.5], [-1.0, -0.5, 1.0]]),
        log_scales=torch.full((3, 3), math.log(0.1)),
        quats=torch.randn(3, 4, generator=generator),
        opacity_logits=torch.tensor([6.0, 7.0, 8.0]),
        sh_dc=torch.rand(3, 1, 3, generator=generator),
        sh_rest=0.1 * torch.randn(3, 8, 3, generator=generator),
    )


def test_splats_are_where_the_camera_projects_the_means(gaussians: Gaussians, camera: Camera):
    splats = project(gaussians, camera)
    position, depth = camera.project(gaussians.means)
    assert splats.ids.tolist() == [0, 1, 2]
    torch.testing.assert_close(splats.means2d, position)
    torch.testing.assert_close(splats.depths, depth)


@pytest.mark.parametrize(("degree", "used"), [(None, 2), (0, 0), (1, 1), (2, 2), (3, 2)])
def test_the_degree_is_at_most_that_of_the_gaussians(
    gaussians: Gaussians, camera: Camera, degree: int | None, used: int
):
    directions = torch.nn.functional.normalize(gaussians.means - camera.position.float(), dim=1)
    coefficients = torch.cat([gaussians.sh_dc, gaussians.sh_rest], 1)[:, : (used + 1) ** 2]
    basis = reference.sh_basis(directions, used)
    expected = 0.5 + torch.einsum("nk,nkc->nc", basis, coefficients)
    torch.testing.assert_close(project(gaussians, camera, degree).colors, expected.clamp_min(0))
    color = render(gaussians, camera, sh_degree=degree).splats.colors
    torch.testing.assert_close(color, expected.clamp_min(0))


def test_a_render_shows_the_gaussians_over_the_background(gaussians: Gaussians, camera: Camera):
    background = torch.tensor([0.2, 0.4, 0.6])
    output = render(gaussians, camera, background, with_depth=True)
    assert output.image.shape == (48, 64, 3)
    assert output.alpha.shape == output.depth.shape == (48, 64)
    # The upper right corner shows none of them; T is 1 there.
    torch.testing.assert_close(output.image[0, -1], background)
    assert float(output.alpha[0, -1]) == 0
    assert float(output.depth[0, -1]) == 0
    position, depth = camera.project(gaussians.means)
    for i, (x, y) in enumerate(position.long().tolist()):
        alpha = float(output.alpha[y, x])
        assert 0.8 < alpha <= 1
        assert float(output.depth[y, x]) / alpha == pytest.approx(float(depth[i]), rel=1e-5)
        expected = alpha * output.splats.colors[i] + (1 - alpha) * background
        torch.testing.assert_close(output.image[y, x], expected, rtol=1e-4, atol=1e-5)


def test_a_render_is_over_black_and_without_depth_by_default(gaussians: Gaussians, camera: Camera):
    output = render(gaussians, camera)
    assert output.depth is None
    over_black = render(gaussians, camera, torch.zeros(3), with_depth=True)
    assert torch.equal(output.image, over_black.image)
    assert not output.image[0, -1].any()
    assert len(output.splats) == 3


def directions() -> torch.Tensor:
    """(H, W, 3) of the pixels of a panorama."""
    longitude = (torch.arange(WIDTH) + 0.5) / WIDTH * 2 * math.pi - math.pi
    latitude = ((torch.arange(WIDTH // 2) + 0.5) / WIDTH * 2 * math.pi - math.pi / 2)[:, None]
    level = latitude.cos()
    down = latitude.sin().expand(-1, WIDTH)
    return torch.stack([level * longitude.sin(), down, level * longitude.cos()], -1)


def ball(centre: list[float], radius: float) -> Gaussians:
    return Gaussians(
        means=torch.tensor([centre]),
        log_scales=torch.full((1, 3), math.log(radius)),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        opacity_logits=torch.tensor([6.0]),
        sh_dc=torch.ones(1, 1, 3),
        sh_rest=torch.zeros(1, 0, 3),
    )


def test_each_pixel_has_the_colour_of_its_direction(monkeypatch):
    def by_direction(gaussians, camera: Camera, background) -> RenderOutput:
        y, x = torch.meshgrid(
            torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij"
        )
        ray = torch.stack(
            [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1
        )
        ray = ray / ray.norm(dim=-1, keepdim=True)
        image = (ray @ camera.cam_from_world[:, :3].float() + 1) / 2
        return RenderOutput(image, image[..., 0], None, None)

    monkeypatch.setattr(panorama, "render", by_direction)
    image = PanoramaRenderer(WIDTH).render(ball([0.0, 0.0, 1.0], 0.1), POSE)
    torch.testing.assert_close(image, (directions() + 1) / 2, atol=2e-3, rtol=0)


@pytest.mark.parametrize("angle", [45.0, 135.0, -45.0, 180.0, 0.0])
def test_a_ball_is_where_its_direction_is(angle):
    """At 45° it is where two sides meet, and at 180° at both borders of the picture."""
    turn = math.radians(angle)
    centre = [3 * math.sin(turn), 0.0, 3 * math.cos(turn)]
    bright = PanoramaRenderer(WIDTH).render(ball(centre, 0.12), POSE)[..., 0]
    mean = (bright[..., None] * directions()).sum((0, 1))
    mean = mean / mean.norm()
    assert float(mean @ torch.tensor(centre) / 3) > math.cos(math.radians(0.2))
    ahead = PanoramaRenderer(WIDTH).render(ball([0.0, 0.0, 3.0], 0.12), POSE)[..., 0]
    same = ahead.roll(round(angle / 360 * WIDTH), dims=1)
    torch.testing.assert_close(bright, same, atol=0.05, rtol=0)  # no edge through the ball


def test_the_background_is_everywhere():
    empty = ball([0.0, 0.0, 1.0], 0.1)
    empty.opacity_logits.fill_(-20.0)
    background = torch.tensor([0.2, 0.5, 0.7])
    image = PanoramaRenderer(64).render(empty, POSE, background)
    torch.testing.assert_close(image, background.expand(32, 64, 3), atol=1e-4, rtol=0)


@pytest.mark.parametrize("width", [0, 6, -4])
def test_a_width_that_is_no_multiple_of_four(width):
    with pytest.raises(ValueError, match="multiple of 4"):
        PanoramaRenderer(width)


@pytest.mark.parametrize("pitch", [0.0, 0.6, -1.2, math.pi / 2, -math.pi / 2])
def test_a_level_pose_keeps_place_and_heading(pitch):
    up = np.array([0.0, -1.0, 0.0])
    cos, sin = math.cos(pitch), math.sin(pitch)
    tilt = torch.tensor([[1, 0, 0], [0, cos, sin], [0, -sin, cos]], dtype=torch.float64)
    centre = torch.tensor([0.5, -2.0, 3.0], dtype=torch.float64)
    pose = torch.cat([tilt, -(tilt @ centre)[:, None]], 1)
    level = level_pose(pose, up)
    torch.testing.assert_close(level[:, :3], torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(-level[:, :3].T @ level[:, 3], centre)
