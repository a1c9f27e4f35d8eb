"""The formulas of docs/learn/projection.md."""

import math

import numpy as np
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


def test_the_jacobian():
    p = torch.tensor([0.7, -0.4, 3.0], dtype=torch.float64)
    J = jacobian(p)
    assert torch.allclose(torch.autograd.functional.jacobian(pi, p), J)
    assert torch.allclose(J @ p, torch.zeros(2, dtype=torch.float64), atol=1e-12)  # exercise 3


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


def test_the_third_row_has_no_effect():
    sigma = torch.diag(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    J = jacobian(torch.tensor([0.3, 0.2, 2.0]))
    for seed in (3, 4):
        third = torch.randn(
            1, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
        )
        full = torch.cat([J, third])
        assert torch.allclose((full @ sigma @ full.T)[:2, :2], J @ sigma @ J.T)


def test_the_error_of_the_approximation():
    """The shift of the mean is about proportional to s/D, and 0 on the axis (200,000 samples)."""
    half = np.random.default_rng(0).standard_normal((100_000, 3))
    samples = np.concatenate([half, -half])

    def shift(size: float, degrees: float) -> float:
        angle = np.radians(degrees)
        p = np.array([np.sin(angle), 0, np.cos(angle)])
        J = np.array([[1 / p[2], 0, -p[0] / p[2] ** 2], [0, 1 / p[2], 0]])
        sigma = np.sqrt(np.linalg.eigvalsh(size**2 * J @ J.T)[1])
        x = p + size * samples
        return np.linalg.norm((x[:, :2] / x[:, 2:]).mean(axis=0) - p[:2] / p[2]) / sigma

    assert shift(0.05, 0) < 1e-3
    assert shift(0.01, 30) == pytest.approx(0.006, abs=0.002)
    assert shift(0.1, 30) == pytest.approx(10 * shift(0.01, 30), rel=0.15)
    assert shift(0.05, 45) > 3 * shift(0.05, 15)


def test_exercise_1():
    """A disc that faces the camera: the approximation is exact."""
    p = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    J = torch.tensor([[200.0, 0, 0], [0, 200.0, 0]], dtype=torch.float64)
    sigma = torch.diag(torch.tensor([0.01, 0.01, 0.0], dtype=torch.float64))
    assert torch.allclose(J @ sigma @ J.T, 400 * torch.eye(2, dtype=torch.float64))
    deviation = math.sqrt(400 + LOW_PASS)
    assert deviation == pytest.approx(20.007, abs=5e-4)
    delta = torch.tensor([0.4, -0.3, 0.0], dtype=torch.float64)
    J = jacobian(p)
    assert torch.allclose(pi(p + delta), pi(p) + J @ delta)
