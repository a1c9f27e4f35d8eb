"""The Python blocks of docs/learn/reference.md run, and their assertions hold."""

import re
from pathlib import Path

import pytest

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
