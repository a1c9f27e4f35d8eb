"""The table of docs/learn/spherical-harmonics.md."""

import math
import re
from pathlib import Path

import pytest
import torch

from snowsplat.ops import reference

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
