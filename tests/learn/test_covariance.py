"""The formulas of docs/learn/covariance.md."""

import pytest
import torch
from torch import Tensor

from snowsplat.ops import reference


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rotation(q: Tensor) -> Tensor:
    """The matrix of the page for a unit quaternion (w, x, y, z)."""
    w, x, y, z = q
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row) for row in rows])


def test_quaternion_product_and_matrix():
    """q v q̄ = (w² − rᵀr) v + 2 (rᵀv) r + 2w (r × v), and its matrix is that of the code."""
    q, v = normal(4, seed=1), normal(3, seed=2)
    q = q / q.norm()
    w, r = q[0], q[1:]
    turned = (w * w - r @ r) * v + 2 * (r @ v) * r + 2 * w * torch.linalg.cross(r, v)
    R = rotation(q)
    assert torch.allclose(R @ v, turned, atol=1e-14)
    assert torch.allclose(R @ R.T, torch.eye(3, dtype=torch.float64), atol=1e-14)
    assert torch.linalg.det(R) == pytest.approx(1)
    found = reference._rotation_matrices(torch.stack([q, -q, 5 * q]))
    for matrix in found:
        assert torch.allclose(matrix, R, atol=1e-14)
