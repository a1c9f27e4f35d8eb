"""The formulas of docs/learn/covariance.md, and the code of experiments/cholesky.py."""

import importlib.util
import json
import math
import re
import statistics
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from snowsplat import Camera, Gaussians
from snowsplat.ops import reference
from snowsplat.ops.reference import LOW_PASS
from snowsplat.scene.render import view_of

ROOT = Path(__file__).resolve().parents[2]


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


def test_the_zero_quaternion_is_the_identity():
    zero = torch.zeros(1, 4, dtype=torch.float64)
    assert torch.equal(reference._rotation_matrices(zero)[0], torch.eye(3, dtype=torch.float64))


def test_eigendecomposition_and_determinants():
    R, s = rotation(torch.nn.functional.normalize(normal(4), dim=0)), normal(3, seed=3).exp()
    sigma = R @ torch.diag(s) @ torch.diag(s) @ R.T
    values, vectors = torch.linalg.eigh(sigma)
    assert torch.allclose(values, s.sort().values ** 2)
    for i in range(3):  # the eigenvectors are the columns of R, up to their signs
        assert ((R.T @ vectors[:, i]).abs().max()) == pytest.approx(1)
    L = torch.linalg.cholesky(sigma)
    assert torch.allclose(L @ L.T, sigma)
    assert sigma.det().sqrt() == pytest.approx(float(s.prod()))
    assert L.diagonal().prod() == pytest.approx(float(s.prod()))


def test_the_gradient_of_the_quaternion_is_perpendicular_to_it():
    q = normal(5, 4).requires_grad_()
    (reference._rotation_matrices(q) * normal(5, 3, 3, seed=4)).sum().backward()
    assert (q.grad * q).sum(dim=1).abs().max() < 1e-14


def test_the_determinant_by_lagrange():
    u0, u1 = normal(3, seed=5), normal(3, seed=6)
    sigma = torch.stack([u0, u1]) @ torch.stack([u0, u1]).T + LOW_PASS * torch.eye(2).double()
    cross = torch.linalg.cross(u0, u1)
    found = cross @ cross + LOW_PASS * (u0 @ u0 + u1 @ u1) + LOW_PASS**2
    assert found == pytest.approx(float(sigma.det()))


def test_exercises():
    q = torch.tensor([1.0, 0, 0, 1], dtype=torch.float64)
    RS = reference._rotation_matrices(q[None])[0] * torch.tensor([2.0, 1, 1])
    assert torch.allclose(RS @ RS.T, torch.diag(torch.tensor([1.0, 4, 1]).double()), atol=1e-14)
    sigma = torch.tensor([[4.0, 2], [2, 5]])
    L = torch.linalg.cholesky(sigma)
    assert torch.allclose(L, torch.tensor([[2.0, 0], [1, 2]]))
    assert L[:, 0].norm() == pytest.approx(2.24, abs=5e-3)
    deviations = torch.linalg.eigvalsh(sigma).sqrt().tolist()
    expected = sorted(math.sqrt((9 + sign * math.sqrt(17)) / 2) for sign in (1, -1))
    assert deviations == pytest.approx(expected)
    assert expected == pytest.approx([1.56, 2.56], abs=5e-3)


@pytest.fixture(scope="module")
def experiment():
    spec = importlib.util.spec_from_file_location("cholesky", ROOT / "experiments" / "cholesky.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["cholesky"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules["cholesky"]


def test_the_projection_of_the_experiment_is_that_of_the_operation(experiment):
    n = 12
    means = normal(n, 3) * 0.7 + torch.tensor([0.0, 0.0, 4.0])
    log_scales, quats = normal(n, 3, seed=1) * 0.3 - 2, normal(n, 4, seed=2)
    logits, colors = normal(n, seed=3) + 1, normal(n, 3, seed=4).sigmoid()
    pose = torch.eye(3, 4, dtype=torch.float64)
    camera = Camera(40, 30, 30.0, 32.0, 20.0, 14.0, pose)
    dc = (colors - 0.5)[:, None] / reference.C0
    rest = torch.zeros(n, 0, 3, dtype=torch.float64)
    gaussians = Gaussians(means, log_scales, quats, logits, dc, rest)
    expected = reference.project(gaussians, view_of(gaussians, camera))
    M = experiment.rotation_and_scales([log_scales, quats])
    found = experiment.project(means, M, logits.sigmoid(), colors, camera)
    rows = expected.ids.long()
    assert len(rows) > 5
    assert len(found) == n  # all are in front of the camera
    assert torch.allclose(found.packed[rows], expected.packed, atol=1e-12)


def test_the_table_of_the_experiment(experiment):
    """The table of the page has the values of experiments/cholesky.json."""
    rows = json.loads((ROOT / "experiments" / "cholesky.json").read_text("utf-8"))
    page = (ROOT / "docs" / "learn" / "covariance.md").read_text("utf-8")
    table = re.findall(
        r"^\| (.+?) \| ([\d.]+) \| ([\d.]+) ± ([\d.]+)"
        r" \| (?:(−[\d.]+) ± ([\d.]+))? ?\| ([\d.]+) \|$",
        page,
        re.MULTILINE,
    )
    assert len(table) == 3
    first: list[float] = []
    for shape, rate, mean, deviation, difference, difference_deviation, ratio in table:
        own = [row | {"psnr": row["psnr"] or -math.inf} for row in rows if row["shape"] == shape]
        runs = experiment.chosen([experiment.Result(**row) for row in own])
        assert {run.rate for run in runs} == {float(rate)}
        runs.sort(key=lambda run: run.seed)
        psnr = [run.psnr for run in runs]
        assert len(psnr) == 5
        assert statistics.mean(psnr) == pytest.approx(float(mean), abs=6e-3)
        assert statistics.stdev(psnr) == pytest.approx(float(deviation), abs=6e-3)
        assert statistics.mean(run.axis_ratio for run in runs) == pytest.approx(
            float(ratio), abs=0.06
        )
        first = first or psnr
        if difference:
            pairs = [a - b for a, b in zip(psnr, first, strict=True)]
            value = float(difference.replace("−", "-"))
            assert statistics.mean(pairs) == pytest.approx(value, abs=6e-3)
            assert statistics.stdev(pairs) == pytest.approx(float(difference_deviation), abs=6e-3)
