"""Flat Gaussians, and the consistency of their normals with the depth."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from snowsplat import Trainer, ops, recipe
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import quat_product
from snowsplat.scene.surface_normals import normals_of_depth, rays_of
from snowsplat.training.parts.surfaces import consistency, planes_of, with_planes

from .sphere import cameras, dataset

NORMAL = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, -1.0]).double(), dim=0)


def camera(size: int = 12) -> Camera:
    turned = torch.tensor([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]]).double()
    pose = torch.cat([turned, torch.tensor([[0.1], [0.2], [0.3]]).double()], dim=1)
    return Camera(size, size, 1.2 * size, 1.1 * size, 0.5 * size, 0.45 * size, pose)


def wall(at: Camera) -> Tensor:
    """(H, W): the depth of the plane NORMAL · x = -3 in the frame of the camera."""
    return -3.0 / torch.einsum("chw,c->hw", rays_of(at, NORMAL), NORMAL)


def test_the_normals_of_a_plane() -> None:
    found = normals_of_depth(wall(camera()), camera())
    torch.testing.assert_close(found[:, 1:-1, 1:-1], NORMAL[:, None, None].expand(3, 10, 10))
    assert not found[:, 0].any()
    assert not found[:, :, -1].any()


def splats_on_the_wall(at: Camera) -> tuple[Splats2D, Tensor]:
    """A splat for each second pixel, and the plane of each: that of the wall."""
    y, x = torch.meshgrid(torch.arange(0, 12, 2), torch.arange(0, 12, 2), indexing="ij")
    y, x = y.flatten(), x.flatten()
    count = len(x)
    conics = torch.tensor([0.3, 0.02, 0.25]).double().expand(count, 3)
    means = torch.stack([x, y], dim=1) + 0.6
    opacities = torch.full((count,), 0.7).double()
    depths = wall(at)[y, x]
    splats = Splats2D.pack(
        means.double(), conics, opacities, depths, torch.zeros(count, 3).double()
    )
    return splats, torch.cat([NORMAL, torch.tensor([-3.0]).double()]).expand(count, 4).clone()


def test_a_flat_wall_is_consistent_wherever_the_centres_are() -> None:
    splats, planes = splats_on_the_wall(camera())
    consistent = consistency(with_planes(splats, planes), camera())
    assert float(consistent) == pytest.approx(0.0, abs=1e-12)
    tilted = torch.nn.functional.normalize(NORMAL + torch.tensor([0.2, 0.0, 0.0]), dim=0)
    x, y = splats.means2d.floor().long().unbind(1)
    distances = splats.depths * (rays_of(camera(), NORMAL)[:, y, x].T @ tilted)
    across = torch.cat([tilted.expand(len(planes), 3), distances[:, None]], dim=1)
    assert float(consistency(with_planes(splats, across), camera())) > 1e-3


def test_its_gradient_by_finite_differences() -> None:
    splats, planes = splats_on_the_wall(camera())
    random = torch.Generator().manual_seed(0)
    planes += 0.03 * torch.randn(planes.shape, generator=random, dtype=torch.float64)

    leaf = with_planes(splats, planes).packed.requires_grad_()
    rays = rays_of(camera(), NORMAL)

    def parts(packed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        image, alpha, _ = ops.rasterize(Splats2D(packed, None, 4), 12, 12)
        *normals, distances = image.unbind(2)
        normals = torch.stack(normals)
        return normals, normals_of_depth(distances / (normals * rays).sum(0), camera()), alpha

    _, before, alpha = (tensor.detach() for tensor in parts(leaf))
    weight = -(before * torch.nn.functional.normalize(rays, dim=0)).sum(0)

    def loss(packed: Tensor) -> Tensor:  # the weight and alpha are constant
        normals, from_depth, _ = parts(packed)
        return (weight * (alpha - (normals * from_depth).sum(0))).mean()

    (found,) = torch.autograd.grad(consistency(Splats2D(leaf, None, 4), camera()), leaf)
    torch.testing.assert_close(found, *torch.autograd.grad(loss(leaf), leaf))
    assert torch.autograd.gradcheck(loss, leaf, fast_mode=True)


def test_planes_face_the_camera_in_its_frame() -> None:
    random = torch.Generator().manual_seed(1)
    means, quats = torch.randn(40, 7, generator=random, dtype=torch.float64).split([3, 4], dim=1)
    axis = torch.randint(3, (40,), generator=random)
    at = camera()
    planes = planes_of(means, quats, axis, at)
    assert (planes[:, 3] <= 0).all()
    pose = at.cam_from_world
    middle = means @ pose[:, :3].T + pose[:, 3]
    torch.testing.assert_close((planes[:, :3] * middle).sum(1), planes[:, 3])
    # The axis, rotated by the quaternion: q e q*.
    unit = torch.nn.functional.normalize(quats, dim=1)
    e = torch.zeros(40, 4).double()
    e[torch.arange(40), axis + 1] = 1.0
    turned = quat_product(quat_product(unit, e), unit * torch.tensor([1.0, -1, -1, -1]).double())
    cosine = (planes[:, :3] * (turned[:, 1:] @ pose[:, :3].T)).sum(1)
    torch.testing.assert_close(cosine.abs(), torch.ones(40).double())


CONFIG = replace(
    recipe("default", iterations=80, init="points", max_gaussians=600, transients="off", sky=False),
    coarse_to_fine=(0, 0),
    few_passes=0.0,
    surfaces=True,
)


def test_gaussians_become_flat_and_lie_in_the_sphere(tmp_path) -> None:
    data = dataset(tmp_path)

    def angle(surfaces: bool) -> tuple[float, float]:
        trainer = Trainer(data, replace(CONFIG, surfaces=surfaces))
        trainer.run()
        g = trainer.gaussians
        scales = g.log_scales.sort(dim=1).values
        axis = g.log_scales.argmin(1)
        planes = planes_of(g.means, g.quats, axis, cameras()[2])
        outward = g.means @ cameras()[2].cam_from_world[:, :3].float().T
        cosine = torch.nn.functional.cosine_similarity(planes[:, :3], outward).abs()
        share = g.opacities / g.opacities.sum()
        return float(share @ (scales[:, 0] - scales[:, 1])), float(share @ cosine)

    (flat, along), (round_, any_way) = angle(True), angle(False)
    assert flat < round_ - 0.1
    assert along > any_way
