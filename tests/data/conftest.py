"""Small datasets that are written once, copies of them to change, and a way to damage files."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.util.errors import UserError


@pytest.fixture(scope="session")
def pristine(tmp_path_factory) -> dict[str, Path]:
    """One dataset of 9 views, 32×24, in each format; not to be changed."""
    root = tmp_path_factory.mktemp("captures")
    formats = ("colmap-bin", "colmap-txt", "blender")
    return {f: write_toy_dataset(root / f, f, 9, 32, 24, n_points=60) for f in formats}


@pytest.fixture
def dataset_copy(pristine, tmp_path) -> Callable[[str], Path]:
    """A function that gives a copy to do anything to."""
    return lambda name: Path(shutil.copytree(pristine[name], tmp_path / name))


@pytest.fixture
def refusals() -> Callable[[Path, Callable[[], object]], int]:
    """A function that damages a file in many ways and reads each: it works or is a UserError.

    Returns how often it was refused; any other exception passes through and fails the test.
    """

    def refusals(path: Path, read: Callable[[], object]) -> int:
        content = path.read_bytes()
        refused = 0
        for variant in damaged(content):
            path.write_bytes(variant)
            try:
                read()
            except UserError as error:
                refused += 1
                if "\n" in str(error):
                    pytest.fail(f"more than one line: {error}")
        path.write_bytes(content)
        return refused

    return refusals


def damaged(content: bytes, flips: int = 60) -> list[bytes]:
    """The content cut at every twentieth, and with single bits changed here and there."""
    cuts = [content[: len(content) * i // 20] for i in range(20)]
    generator = random.Random(0)
    flipped = []
    for _ in range(flips):
        changed = bytearray(content)
        # The heads of files are where the counts are, so they get half of the hits.
        limit = len(content) if generator.random() < 0.5 else min(len(content), 100)
        changed[generator.randrange(limit)] ^= 1 << generator.randrange(8)
        flipped.append(bytes(changed))
    return cuts + flipped
