"""The Python blocks of docs/learn/reference.md run, and their assertions hold."""

import re
from pathlib import Path

import pytest
import torch

PAGE = Path(__file__).resolve().parents[2] / "docs" / "learn" / "reference.md"


@pytest.fixture(scope="module")
def names() -> dict:
    """The variables after all blocks of the page."""
    page = PAGE.read_text(encoding="utf-8")
    blocks = re.findall(r"(?<!-->\n)^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 7
    variables: dict = {}
    for block in blocks:
        exec(block, variables)
    return variables


def test_the_blocks_of_the_page_run(names):
    assert len(names["losses"]) == 60


def test_exercises(names):
    order = [2, 0, 1]
    splats = names["reference"].project(
        names["gaussians"].select(torch.tensor(order)), names["view"]
    )
    white = torch.ones(3, dtype=torch.float64)
    image, _, _ = names["reference"].rasterize(splats, 48, 40, white)
    assert torch.allclose(image, names["image"])
    # One Gaussian at depth 4: depth = 4 · alpha.
    first = names["reference"].project(names["gaussians"].select(torch.tensor([0])), names["view"])
    _, alpha, depth = names["reference"].rasterize(first, 48, 40, with_depth=True)
    assert torch.allclose(depth, 4 * alpha)
