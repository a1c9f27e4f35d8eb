"""Links, tangents, discs: compared with planes, whose tangents are known in closed form."""

import pytest
import torch

from snowsplat.extras.lift.lift import SIGMA, discs, sigma_of_block
from snowsplat.extras.lift.surface import find_links, resize_depth, snap_to_surfaces, surface_of
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.scene.render import project

POSE = torch.tensor([[0.0, 0, 1, 0.3], [1, 0, 0, -0.2], [0, 1, 0, 0.1]], dtype=torch.float64)
CAMERA = Camera(24, 16, 30.0, 28.0, 11.0, 8.5, POSE)
NORMALS = [(0.0, 0.0, -1.0), (0.5, 0.0, -1.0), (0.3, -0.6, -1.0)]


def rays() -> torch.Tensor:
    u = (torch.arange(24) + 0.5 - CAMERA.cx) / CAMERA.fx
    v = (torch.arange(16) + 0.5 - CAMERA.cy) / CAMERA.fy
    v, u = torch.meshgrid(v, u, indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)], -1)


def plane(normal) -> torch.Tensor:
    """(16, 24): the depth of the plane n · x = n · (0, 0, 2)."""
    n = torch.tensor(normal)
    return 2 * n[2] / (rays() @ n)


@pytest.mark.parametrize("normal", NORMALS)
def test_points_and_tangents_of_a_plane(normal):
    depth, n = plane(normal), torch.tensor(normal)
    surface = surface_of(depth, CAMERA, find_links(depth, 1.0))
    offset = 2 * n[2]
    torch.testing.assert_close(surface.points @ n, offset.expand_as(depth))
    # P = r z with z = offset / (n · r), so ∂P/∂u = (∂r/∂u − r (n · ∂r/∂u) / (n · r)) z.
    r = rays()
    for i, focal in enumerate((CAMERA.fx, CAMERA.fy)):
        change = torch.zeros(3)
        change[i] = 1 / focal
        expected = (change - r * (change @ n / (r @ n))[..., None]) * depth[..., None]
        torch.testing.assert_close(surface.tangents[..., i], expected, rtol=1e-4, atol=1e-5)


def test_a_steep_surface_is_limited():
    depth = plane((9.0, 0.0, -1.0))[:, 11:13].clone()
    camera = Camera(2, 16, 30.0, 28.0, 0.0, 8.5, POSE)
    surface = surface_of(depth, camera, find_links(depth, 1.0))
    slope = surface.tangents[:, 0, 2, 0] / (depth[:, 0] / camera.fx)
    assert float(slope.abs().max()) == pytest.approx(4.0)


@pytest.mark.parametrize("normal", NORMALS)
def test_discs_are_circles_in_the_image_and_lie_in_the_plane(normal):
    depth = plane(normal)
    surface = surface_of(depth, CAMERA, find_links(depth, 1.0))
    points, tangents = surface.points.flatten(0, 1), surface.tangents.flatten(0, 1)
    gaussians = discs(points, tangents, torch.full_like(points, 0.25), CAMERA, sigma=1.5)
    splats = project(gaussians, CAMERA)
    # The rasterizer adds 0.3 to the covariance; the disc has a thickness of a tenth.
    expected = torch.tensor([1.0, 0.0, 1.0]) / (1.5**2 + 0.3)
    assert len(splats.packed) == len(points)
    middle = splats.packed[:, 2:5][(splats.packed[:, 0] - 11).abs() < 3]
    torch.testing.assert_close(middle, expected.expand_as(middle), rtol=0.08, atol=0.02)
    normals = rotation_from_quat(gaussians.rotations)[:, :, 2]
    in_world = CAMERA.world_from_cam[:, :3].float() @ torch.nn.functional.normalize(
        torch.tensor(normal), dim=0
    )
    torch.testing.assert_close((normals @ in_world).abs(), torch.ones(len(points)))
    torch.testing.assert_close(gaussians.base_colors, torch.full_like(points, 0.25))
    pixels, z = CAMERA.project(gaussians.means.double())
    torch.testing.assert_close(z.float(), depth.flatten())
    torch.testing.assert_close(pixels[0].float(), torch.tensor([0.5, 0.5]))


def test_discs_of_blocks_overlap_like_those_of_pixels():
    size = torch.tensor([1.0, 2.0, 16.0])
    sigma = sigma_of_block(size)
    assert float(sigma[0]) == pytest.approx(SIGMA)
    torch.testing.assert_close(
        (sigma.square() + 0.3) / size.square(), torch.full((3,), SIGMA**2 + 0.3)
    )


def test_points_are_differentiable_in_the_depth():
    depth = plane(NORMALS[1]).requires_grad_()
    surface = surface_of(depth, CAMERA, find_links(depth.detach()))
    points, tangents = surface.points.flatten(0, 1), surface.tangents.flatten(0, 1)
    gaussians = discs(points, tangents, torch.zeros_like(points), CAMERA)
    (gradient,) = torch.autograd.grad(gaussians.means.sum(), depth)
    towards = rays() @ CAMERA.world_from_cam[:, :3].float().T
    torch.testing.assert_close(gradient, towards.sum(-1))


def test_links_end_at_a_step_and_at_unknown_depths():
    depth = torch.full((4, 6), 2.0)
    depth[:, 3:] = 2.2
    depth[1, 1] = torch.nan
    links = find_links(depth, 0.05)
    assert links.right.sum(0).tolist() == [3, 3, 0, 4, 4]
    assert not links.down[:2, 1].any()
    assert bool(find_links(depth, 0.1).right[0, 2])


def test_pixels_between_two_surfaces_move_to_the_closer_one():
    depth = torch.full((5, 9), 1.0)
    depth[:, 5:] = 4.0
    depth[:, 3], depth[:, 4] = 1.3, 3.0
    snapped = snap_to_surfaces(depth)
    assert snapped[:, 3].tolist() == [1.0] * 5
    assert snapped[:, 4].tolist() == [4.0] * 5
    torch.testing.assert_close(snap_to_surfaces(depth.T), snapped.T)
    exact = torch.full((5, 9), 1.0)
    exact[:, 4:] = 4.0
    exact[2, 2] = torch.nan
    torch.testing.assert_close(snap_to_surfaces(exact), exact, equal_nan=True)


def test_resizing_keeps_planes_and_discontinuities():
    large = plane(NORMALS[2]).repeat_interleave(4, 0).repeat_interleave(4, 1)
    torch.testing.assert_close(resize_depth(plane(NORMALS[2]), 96, 64), large, rtol=0.06, atol=0)
    step = torch.full((8, 8), 1.0)
    step[:, 4:] = 4.0
    resized = resize_depth(step, 24, 24)
    assert set(resized.flatten().tolist()) == {1.0, 4.0}
    assert resize_depth(step, 8, 8) is step
