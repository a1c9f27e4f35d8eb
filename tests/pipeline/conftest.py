"""A small dataset."""

from pathlib import Path

import pytest

from snowsplat.synthetic.toy_dataset import write_toy_dataset


@pytest.fixture(scope="session")
def dataset(tmp_path_factory) -> Path:
    """9 views, 48×36; read-only for the tests."""
    root = tmp_path_factory.mktemp("pipeline")
    return write_toy_dataset(root / "dataset", "colmap-bin", 9, 48, 36, n_points=300)
