"""The formulas of docs/learn/spherical-harmonics.md, including its table."""

import math
import re
from pathlib import Path

import pytest
import torch

from snowsplat import Gaussians
from snowsplat.ops import View, reference
from snowsplat.scene.edit import sh_rotation

PAGE = Path(__file__).resolve().parents[2] / "docs" / "learn" / "spherical-harmonics.md"


def directions(n: int) -> torch.Tensor:
    v = torch.randn(n, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return v / v.norm(dim=1, keepdim=True)


def test_the_table_is_that_of_the_code():
    """Every row: function, factor as a root, and factor as a number."""
    rows = re.findall(
        r"^\| (\d+) \| (\d), (\S+) \| \$(.+?)\$ \| \$\\sqrt\{(.+?)\}\$ \| ([\d.]+) \|",
        PAGE.read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    assert [int(row[0]) for row in rows] == list(range(16))
    v = directions(7)
    basis = reference.sh_basis(v, 3)
    for k, l, m, function, root, number in rows:
        degree, order = int(l), int(m.replace("−", "-"))
        assert int(k) == degree**2 + degree + order
        numerator, denominator = root.split("/")
        factor = math.sqrt(float(numerator) / (float(denominator.replace("\\pi", "")) * math.pi))
        assert factor == pytest.approx(float(number), abs=6e-6)
        code = re.sub(
            r"(\d)(?=[xyz(])", r"\1*", function.replace("\\thinspace", " ").replace("^", "**")
        )
        code = re.sub(r"(?<=[xyz)])\s*(?=[xyz(])|(?<=\*\*2)(?=[xyz(])", "*", code)
        x, y, z = v.unbind(dim=1)
        values = eval(code, {"x": x, "y": y, "z": z}) + 0 * x
        assert torch.allclose(factor * values, basis[:, int(k)], atol=1e-12), (k, code)


def test_the_colour_is_that_of_the_code():
    """c = max(0, ½ + Σ h_k Y_k(v)), with v from the camera to the centre."""
    g = torch.Generator().manual_seed(2)
    h = torch.randn(1, 16, 3, generator=g, dtype=torch.float64)
    mean = torch.tensor([[0.3, -0.2, 0.1]], dtype=torch.float64)
    pose = torch.eye(3, 4, dtype=torch.float64)
    pose[:, 3] = torch.tensor([0.2, 0.1, 3.0])
    scene = Gaussians(
        mean,
        torch.full((1, 3), -2.0).double(),
        torch.eye(1, 4).double(),
        torch.zeros(1).double(),
        h[:, :1],
        h[:, 1:],
    )
    splats = reference.project(scene, View(pose, 32, 32, 30.0, 30.0, 16.0, 16.0, sh_degree=3))
    u = mean[0] + pose[:, 3]  # W = I: the camera is at −t
    Y = reference.sh_basis((u / u.norm())[None], 3)[0]
    assert torch.allclose(splats.colors[0], (0.5 + Y @ h[0]).clamp(min=0))


def test_rotation_of_coefficients():
    """D = A⁺ B turns the function: Y(v)ᵀ D h = Y(Qᵀ v)ᵀ h."""
    Q, _ = torch.linalg.qr(directions(3))
    Q = Q * torch.linalg.det(Q).sign()
    v = directions(40)
    A, B = reference.sh_basis(v, 3), reference.sh_basis(v @ Q, 3)  # rows Qᵀ v
    D = torch.linalg.pinv(A) @ B
    assert torch.allclose(A @ D, B, atol=1e-10)
    for degree, matrix in enumerate(sh_rotation(Q, 3), 1):
        block = slice(degree**2, (degree + 1) ** 2)
        assert torch.allclose(D[block, block], matrix.double(), atol=1e-6)
        D[block, block] = 0
    D[0, 0] = 0
    assert D.abs().max() < 1e-10  # the degrees do not mix
