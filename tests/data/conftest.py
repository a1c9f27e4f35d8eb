"""Fixtures: small datasets, and copies of them that a test may change."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from snowsplat.synthetic.toy_dataset import write_toy_dataset


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
