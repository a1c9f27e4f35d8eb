"""The formulas of docs/learn/projection.md."""

import pytest
import torch
from torch import Tensor

from snowsplat import Gaussians
from snowsplat.ops import View, reference
from snowsplat.ops.reference import LOW_PASS

FX, FY, CX, CY, WIDTH, HEIGHT = 60.0, 62.0, 33.0, 22.0, 64, 48


def pi(p: Tensor) -> Tensor:
    return torch.stack([FX * p[0] / p[2] + CX, FY * p[1] / p[2] + CY])


def jacobian(p: Tensor, clamped: bool = False) -> Tensor:
    """J of the page; with the limits of x/z and y/z if `clamped`."""
    x, y, z = p.tolist()
    tx, ty = x / z, y / z
    if clamped:
        tx = min(max(tx, -(CX + 0.15 * WIDTH) / FX), (WIDTH - CX + 0.15 * WIDTH) / FX)
        ty = min(max(ty, -(CY + 0.15 * HEIGHT) / FY), (HEIGHT - CY + 0.15 * HEIGHT) / FY)
    rows = [[FX / z, 0, -FX * tx / z], [0, FY / z, -FY * ty / z]]
    return torch.tensor(rows, dtype=torch.float64)


def rotation(seed: int) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    Q, _ = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64))
    return Q * torch.linalg.det(Q).sign()


def project(means: Tensor, log_scales: Tensor, quats: Tensor, pose: Tensor):
    n = len(means)
    gaussians = Gaussians(
        means,
        log_scales,
        quats,
        torch.zeros(n, dtype=torch.float64),
        torch.zeros(n, 1, 3, dtype=torch.float64),
        torch.zeros(n, 0, 3, dtype=torch.float64),
    )
    return reference.project(gaussians, View(pose, WIDTH, HEIGHT, FX, FY, CX, CY))


def test_the_covariance_in_the_image_is_that_of_the_code():
    """Σ' = J W Σ Wᵀ Jᵀ + 0.3 I, m = π(p); also for a centre outside of the clamped region."""
    g = torch.Generator().manual_seed(1)
    W = rotation(2)
    t = torch.tensor([0.1, -0.2, 4.0], dtype=torch.float64)
    beyond = torch.tensor([2.9, 0.3, 3.0], dtype=torch.float64)  # x/z is larger than its limit
    camera_points = torch.randn(5, 3, generator=g, dtype=torch.float64) * 0.5
    camera_points[:, 2] += 4
    camera_points = torch.cat([camera_points, beyond[None]])
    means = (camera_points - t) @ W  # Wᵀ (p − t)
    log_scales = torch.randn(6, 3, generator=g, dtype=torch.float64) * 0.3 - 1
    quats = torch.randn(6, 4, generator=g, dtype=torch.float64)
    splats = project(means, log_scales, quats, torch.cat([W, t[:, None]], dim=1))
    assert splats.ids.tolist() == list(range(6))
    for i, p in enumerate(camera_points):
        R = reference._rotation_matrices(quats[i : i + 1])[0]
        S = torch.diag(log_scales[i].exp())
        sigma = R @ S @ S.T @ R.T
        J = jacobian(p, clamped=True)
        expected = J @ W @ sigma @ W.T @ J.T + LOW_PASS * torch.eye(2)
        a, b, c = splats.conics[i].tolist()
        conic = torch.tensor([[a, b], [b, c]], dtype=torch.float64)
        assert torch.allclose(torch.linalg.inv(conic), expected, rtol=1e-9)
        A, B, C = expected[0, 0], expected[0, 1], expected[1, 1]
        inverse = torch.stack([C, -B, A]) / (A * C - B * B)
        assert torch.allclose(splats.conics[i], inverse, rtol=1e-9)
        assert torch.allclose(splats.means2d[i], pi(p))
    assert not torch.allclose(jacobian(beyond), jacobian(beyond, clamped=True))


def test_two_points_instead_of_the_jacobian():
    """The example of docs/learn/since-2023.md: y = 1/z at z = 1 ± s, and a series of the mean."""
    s = 0.3
    y = [1 / (1 - s), 1 / (1 + s)]
    assert (y[0] + y[1]) / 2 == pytest.approx(1 / (1 - s**2)) == pytest.approx(1.099, abs=5e-4)
    assert (y[0] - y[1]) / 2 == pytest.approx(s / (1 - s**2)) == pytest.approx(0.330, abs=5e-4)
    assert 1 + s**2 + 3 * s**4 == pytest.approx(1.114, abs=5e-4)
