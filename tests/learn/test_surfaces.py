"""The formulas of docs/learn/surfaces.md."""

import math

import numpy as np
import pytest
import torch

from snowsplat.ops import reference
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.surface.depth import SurfaceRenderer
from snowsplat.surface.volume import SIDE, Volume, block_keys, zero_level
from snowsplat.training.parts.depth_supervision import depth_term
from snowsplat.training.parts.surfaces import planes_of

DOUBLE = {"dtype": torch.float64}


def depths_of(alphas: list[float], depths: list[float]) -> tuple[float, float]:
    """Mean and median depth of a pixel, by the reference."""
    n = len(alphas)
    z = torch.tensor(depths, **DOUBLE)
    splats = Splats2D.pack(
        torch.full((n, 2), 0.5, **DOUBLE),
        torch.tensor([[0.5, 0.0, 0.5]], **DOUBLE).repeat(n, 1),
        torch.tensor(alphas, **DOUBLE),
        z,
        z[:, None],
    )
    median, total, alpha = reference.rasterize_median(splats, 1, 1)
    return float(total / alpha), float(median)


@pytest.mark.parametrize(
    ("alpha", "mean", "median"), [(0.8, 2.55, 2), (0.6, 3.125, 2), (0.4, 3.72, 5), (0.2, 4.35, 5)]
)
def test_mean_and_median_at_an_edge(alpha, mean, median):
    found = depths_of([alpha, 0.9], [2.0, 5.0])
    assert found == (pytest.approx(mean, abs=5e-3), median)
    w1, w2 = alpha, 0.9 * (1 - alpha)
    assert found[0] - 2 == pytest.approx((5 - 2) * w2 / (w1 + w2))


def one_gaussian(scales: list[float]) -> tuple[Gaussians, torch.Tensor]:
    """One Gaussian before a camera at the origin, and M = Σ⁻¹."""
    quats = torch.tensor([[0.9, 0.3, -0.2, 0.1]])
    gaussians = Gaussians(
        torch.tensor([[0.2, -0.1, 3.0]]),
        torch.tensor([scales]).log(),
        quats,
        torch.tensor([3.0]),
        torch.zeros(1, 1, 3),
        torch.zeros(1, 0, 3),
    )
    axes = rotation_from_quat(quats)[0].double()
    return gaussians, axes @ torch.diag(torch.tensor(scales, **DOUBLE) ** -2) @ axes.T


@pytest.mark.parametrize("scales", [[0.5, 0.4, 0.1], [0.5, 0.4, 0.001]])
def test_where_a_gaussian_is_densest_along_a_ray(scales):
    gaussians, M = one_gaussian(scales)
    mean = gaussians.means[0].double()
    z, centre = mean[2], mean / mean[2]
    g = M @ centre / (centre @ M @ centre)

    def depth(d: torch.Tensor) -> torch.Tensor:
        return (d @ M @ mean) / (d @ M @ d)

    d = centre + torch.tensor([0.02, -0.03, 0.0], **DOUBLE)
    t = depth(d)
    near = [float((p := s * t * d - mean) @ M @ p) for s in (0.999, 1.0, 1.001)]
    assert near[1] == min(near)
    slope = torch.autograd.functional.jacobian(lambda d: 1 / depth(d), centre)
    assert torch.allclose(slope, (2 * g - g) / z)  # g · d₀ = 1, so only M e is left
    if scales[2] < 0.01:  # flat: the plane
        assert float(1 / t) == pytest.approx(float(g @ d / z), rel=1e-4)

    pose = torch.eye(3, 4, dtype=torch.float64)
    camera = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, pose)
    found = SurfaceRenderer(gaussians).render(camera).depth
    row, column = 24, 38
    ray = torch.tensor([(column + 0.5 - 32) / 60, (row + 0.5 - 24) / 60, 1.0], **DOUBLE)
    assert float(found[row, column]) == pytest.approx(float(z / (g @ ray)), rel=1e-3)


def test_the_plane_of_a_pixel_does_not_depend_on_the_centres():
    half = math.atan(0.5) / 2  # turns the z axis into the normal of z = 2 + x / 2
    quats = torch.tensor([[math.cos(half), 0.0, -math.sin(half), 0.0]], **DOUBLE).repeat(2, 1)
    means = torch.tensor([[-0.5, 0.0, 1.75], [0.5, 0.0, 2.25]], **DOUBLE)
    camera = Camera(8, 8, 8.0, 8.0, 4.0, 4.0, torch.eye(3, 4, dtype=torch.float64))
    planes = planes_of(means, quats, torch.tensor([2, 2]), camera)
    weights = torch.tensor([0.6, 0.2], **DOUBLE)
    N, distance = (weights @ planes).split([3, 1])
    assert float(distance / N[2]) == pytest.approx(2)
    assert float(weights @ means[:, 2] / weights.sum()) == pytest.approx(1.875)


@pytest.mark.parametrize(("residual", "pull"), [(0.003, 0.91), (0.03, 0.5), (0.3, 0.09)])
def test_the_pull_of_a_wrong_depth(residual, pull):
    inverse = torch.ones(100, 100, **DOUBLE)
    inverse[0, 0] += residual
    inverse.requires_grad_()
    term, _ = depth_term(1 / inverse, torch.ones_like(inverse), torch.ones_like(inverse), 1.0)
    term.backward()
    assert inverse.grad is not None
    assert float(inverse.grad[0, 0]) * inverse.numel() == pytest.approx(pull, abs=5e-3)


def fused_at(z: np.ndarray, maps: list[tuple[float, float]], truncation: float) -> np.ndarray:
    """(len(z), 2): W and D of voxels at depths, by the reference."""
    sums = torch.zeros(len(z), 1, 1, 1, 2, **DOUBLE)
    origins = torch.tensor(np.stack([0 * z, 0 * z, z], 1))
    image = torch.tensor([[1.0, 0, 0.5, 0], [0, 1, 0.5, 0], [0, 0, 1, 0]], **DOUBLE)
    for depth, weight in maps:
        full = (torch.full((1, 1), value, **DOUBLE) for value in (depth, weight))
        reference.fuse_depth(sums, origins, 0.0, image, *full, truncation)
    weight, total = sums[:, 0, 0, 0].numpy().T
    return np.stack([weight, total / weight], 1)


def test_the_running_mean_of_signed_distances():
    maps = [(2.00, 1.0), (2.03, 0.5), (1.96, 0.5)]
    expected = [(1.0, 0.2), (1.5, 0.3), (1.9, 0.37 / 1.9)]
    for count, row in enumerate(expected, 1):
        assert fused_at(np.array([1.98]), maps[:count], 0.1)[0] == pytest.approx(row)
    field = fused_at(np.array([2.0018, 2.002]), maps, 0.1)[:, 1]
    assert field[0] > 0 > field[1]


def test_a_surface_net_crosses_where_the_field_is_zero():
    """A plane between two voxels: u = 0.03 / (0.03 + 0.01)."""
    z = torch.arange(SIDE, dtype=torch.float32)
    sums = torch.ones(1, SIDE, SIDE, SIDE, 2)
    sums[..., 1] = (0.04 * (2.75 - z))[:, None, None]
    vertices, faces = zero_level(Volume(1.0, block_keys(np.zeros((1, 3), int)), sums))
    assert np.allclose(vertices[:, 2], 2.75)
    assert len(faces) == 2 * (SIDE - 2) ** 2
