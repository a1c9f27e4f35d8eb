"""docs/learn/ply.md: its header, its table, its reader and its exercises."""

import re
from pathlib import Path

import numpy as np
import pytest

from snowsplat.formats import GaussianArrays
from snowsplat.formats.ply import write_ply

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "learn" / "ply.md").read_text("utf-8")


def scene(degree: int, n: int = 5) -> GaussianArrays:
    random = np.random.default_rng(degree)
    shapes = ((n, 3), (n, 3), (n, 4), (n,), (n, 1, 3), (n, (degree + 1) ** 2 - 1, 3))
    return GaussianArrays(*(random.normal(size=shape).astype(np.float32) for shape in shapes))


def header(path: Path) -> list[str]:
    text = path.read_bytes()
    return text[: text.index(b"end_header\n") + 11].decode().splitlines()


def test_the_header_of_the_page(tmp_path):
    (block,) = re.findall(r"```text\n(ply\n.*?)```", PAGE, re.DOTALL)
    expected = [line for line in block.splitlines() if not line.startswith("element")]
    at = expected.index("(… f_rest_1 to f_rest_8)")
    expected[at : at + 1] = [f"property float f_rest_{i}" for i in range(1, 9)]
    write_ply(tmp_path / "scene.ply", scene(1))
    found = [line for line in header(tmp_path / "scene.ply") if not line.startswith("element")]
    assert [line for line in found if not line.startswith("comment")] == expected


def test_the_table_of_the_page(tmp_path):
    """Names and numbers of columns, in this order, at degree 3."""
    names = []
    rows = re.findall(r"^\| (`[^|]+) \| (\d+) \|", PAGE, re.MULTILINE)
    for fields, count in rows:
        words = re.findall(r"`(\w+)`", fields)
        if "…" in fields:
            prefix, first = words[0].rsplit("_", 1)
            last = int(words[1].rsplit("_", 1)[1])
            words = [f"{prefix}_{i}" for i in range(int(first), last + 1)]
        assert len(words) == int(count)
        names += words
    write_ply(tmp_path / "scene.ply", scene(3))
    lines = header(tmp_path / "scene.ply")
    assert [line.split()[2] for line in lines if line.startswith("property")] == names
    assert len(names) == 62
    size = (tmp_path / "scene.ply").stat().st_size - len("\n".join(lines)) - 1
    assert size == 5 * 248


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_reader_of_the_page(tmp_path, degree):
    (code,) = re.findall(r"(?<!-->\n)```python\n(.*?)```", PAGE, re.DOTALL)
    names: dict = {}
    exec(code, names)
    arrays = scene(degree)
    write_ply(tmp_path / "scene.ply", arrays)
    found = names["read_scene"](tmp_path / "scene.ply")
    assert np.array_equal(found["means"], arrays.means)
    assert found["scales"] == pytest.approx(np.exp(arrays.log_scales))
    assert found["opacities"] == pytest.approx(1 / (1 + np.exp(-arrays.opacity_logits)))
    norms = np.linalg.norm(arrays.quats, axis=1, keepdims=True)
    assert found["quats"] == pytest.approx(arrays.quats / norms)
    assert np.array_equal(found["sh_dc"], arrays.sh_dc[:, 0])
    if degree:
        assert np.array_equal(found["sh_rest"], arrays.sh_rest)
