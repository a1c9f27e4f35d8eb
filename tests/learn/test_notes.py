"""The formulas that answer docs/learn/notes.md, and the map of docs/learn/equations.md."""

import ast
import math
import re
from pathlib import Path

import pytest
import torch
from torch.autograd.functional import jacobian

from snowsplat.ops import View, reference

ROOT = Path(__file__).resolve().parents[2]
DOUBLE = {"dtype": torch.float64}
P = torch.tensor([0.7, -0.4, 3.0], **DOUBLE)
N, F, HALF, WIDTH = 0.5, 20.0, 0.4, 640.0


def boxed(p: torch.Tensor) -> torch.Tensor:
    x, y, z = p
    return torch.stack([N * x / z, N * y / z, N + F - N * F / z])


def test_the_jacobian_with_near_and_far_planes():
    x, y, z = P.tolist()
    rows = [[N / z, 0, -N * x / z**2], [0, N / z, -N * y / z**2], [0, 0, N * F / z**2]]
    assert torch.allclose(jacobian(boxed, P), torch.tensor(rows, **DOUBLE))
    for depth in (N, F):  # both planes keep their depth
        assert boxed(torch.tensor([0.1, 0.2, depth], **DOUBLE))[2] == pytest.approx(depth)

    def behind(p: torch.Tensor) -> torch.Tensor:  # a camera that looks along -z
        return boxed(p * torch.tensor([1.0, 1.0, -1.0], **DOUBLE))

    assert jacobian(behind, P * torch.tensor([1.0, 1.0, -1.0], **DOUBLE))[2, 2] < 0


def test_the_viewport_is_in_a_focal_length_in_pixels():
    factor = WIDTH / (2 * HALF)
    focal = N * factor

    def pixels(p: torch.Tensor) -> torch.Tensor:
        return WIDTH / 2 * (boxed(p)[:2] / HALF + 1)

    J = jacobian(pixels, P)
    assert torch.allclose(J, factor * jacobian(boxed, P)[:2])
    assert J[0, 0] == pytest.approx(focal / 3.0)
    # The code, with this focal length, has the covariance J Σ Jᵀ: no further factor.
    scales = torch.tensor([[0.1, 0.2, 0.3]], **DOUBLE)
    eye = torch.eye(3, 4, **DOUBLE)
    view = View(eye, width=640, height=640, fx=focal, fy=focal, cx=320.0, cy=320.0)
    splats = reference.project(
        _Gaussian(P[None], scales.log(), torch.tensor([[1.0, 0, 0, 0]], **DOUBLE)), view
    )
    a, b, c = splats.conics[0]
    found = torch.stack([torch.stack([a, b]), torch.stack([b, c])]).inverse()
    low_pass = reference.LOW_PASS * torch.eye(2, **DOUBLE)
    assert torch.allclose(found, J @ torch.diag(scales[0] ** 2) @ J.T + low_pass)


class _Gaussian:
    """One opaque grey Gaussian."""

    def __init__(self, means, log_scales, quats) -> None:
        self.means, self.log_scales, self.quats = means, log_scales, quats
        self.opacity_logits = torch.tensor([3.0], **DOUBLE)
        self.sh_dc, self.sh_rest = torch.zeros(1, 1, 3, **DOUBLE), torch.zeros(1, 0, 3, **DOUBLE)

    def parameters(self) -> dict[str, torch.Tensor]:
        return vars(self)


def legendre(l: int, m: int, x: float) -> float:
    """P_l^m with the factor (−1)^m, by the recurrence in l."""
    value = (-1) ** m * math.prod(range(1, 2 * m, 2)) * (1 - x * x) ** (m / 2)
    before = 0.0
    for degree in range(m + 1, l + 1):
        after = ((2 * degree - 1) * x * value - (degree + m - 1) * before) / (degree - m)
        before, value = value, after
    return value


def test_legendre_functions_are_the_polynomials_of_the_code():
    theta, phi = 1.1, 2.3
    v = torch.tensor(
        [[math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)]],
        **DOUBLE,
    )
    basis, opposite = reference.sh_basis(v, 3)[0], reference.sh_basis(-v, 3)[0]
    for l in range(4):
        for m in range(-l, l + 1):
            n = abs(m)
            K = (2 * l + 1) / (4 * math.pi) * math.factorial(l - n) / math.factorial(l + n)
            angle = math.cos(m * phi) if m >= 0 else math.sin(n * phi)
            expected = math.sqrt(K * (2 if m else 1)) * angle * legendre(l, n, math.cos(theta))
            k = l * l + l + m
            assert basis[k] == pytest.approx(expected, abs=1e-12), (l, m)
            assert opposite[k] == pytest.approx((-1) ** l * expected, abs=1e-12)


def test_the_axis_of_the_smallest_scale_is_the_normal_of_a_flat_gaussian():
    quat = torch.tensor([[0.8, 0.1, 0.5, -0.2]], **DOUBLE)
    R = reference._rotation_matrices(quat)[0]
    scales = torch.tensor([0.5, 0.01, 0.3], **DOUBLE)
    points = torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0), **DOUBLE)
    _, _, axes = torch.pca_lowrank(points * scales @ R.T, q=3)
    for found, column in zip(axes.T, (0, 2, 1), strict=True):  # from the longest to the shortest
        assert abs(found @ R[:, column]) > 0.999


def functions(file: Path) -> set[str]:
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".py":
        kinds = (ast.FunctionDef, ast.ClassDef)
        return {node.name for node in ast.walk(ast.parse(text)) if isinstance(node, kinds)}
    return set(re.findall(r"\b(\w+)\(", text))


def test_every_function_of_the_map_exists():
    rows = (ROOT / "docs" / "learn" / "equations.md").read_text("utf-8").splitlines()
    checked = 0
    for row in rows:
        found = re.search(r"`([\w/]+\.(?:py|h))`(.*)$", row) if row.startswith("| ") else None
        if found is None:
            continue
        names = re.findall(r"`(\w+)`", found[2])
        assert names, row
        missing = set(names) - functions(ROOT / "src" / "snowsplat" / found[1])
        assert not missing, row
        checked += 1
    assert checked >= 25
