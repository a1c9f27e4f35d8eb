"""Fixtures: small datasets, copies of them that a test may change, and damaged files."""

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.util.errors import UserError


@pytest.fixture(scope="session")
def pristine(tmp_path_factory) -> dict[str, Path]:
    """One dataset of 9 views, 32×24, in each format. Tests must not change it."""
    root = tmp_path_factory.mktemp("datasets")
    formats = ("colmap-bin", "colmap-txt", "blender")
    return {f: write_toy_dataset(root / f, f, 9, 32, 24, n_points=60) for f in formats}


@pytest.fixture
def dataset_copy(pristine, tmp_path) -> Callable[[str], Path]:
    """A function that returns a copy that the test may change."""
    return lambda name: Path(shutil.copytree(pristine[name], tmp_path / name))


@pytest.fixture
def count_rejected() -> Callable[[Path, Callable[[], object]], int]:
    """A function that damages a file in many ways and reads each version.

    Reading must succeed or raise `UserError`. The function returns the number of rejected versions.
    Any other exception passes through and fails the test.
    """

    def count_rejected(path: Path, read: Callable[[], object]) -> int:
        content = path.read_bytes()
        rejected = 0
        for variant in damaged(content):
            path.write_bytes(variant)
            try:
                read()
            except UserError as error:
                rejected += 1
                if "\n" in str(error):
                    pytest.fail(f"more than one line: {error}")
        path.write_bytes(content)
        return rejected

    return count_rejected


def damaged(content: bytes, flips: int = 60) -> list[bytes]:
    """Versions of ``content``: truncated at each twentieth, and with one random bit flipped."""
    cuts = [content[: len(content) * i // 20] for i in range(20)]
    generator = random.Random(0)
    flipped = []
    for _ in range(flips):
        changed = bytearray(content)
        # Counts are at the start of files, so at least half of the flips are there.
        limit = len(content) if generator.random() < 0.5 else min(len(content), 100)
        changed[generator.randrange(limit)] ^= 1 << generator.randrange(8)
        flipped.append(bytes(changed))
    return cuts + flipped
