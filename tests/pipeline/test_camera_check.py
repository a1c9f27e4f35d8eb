"""A training refuses impossible cameras before it writes anything, unless they are trusted."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import pytest

from snowsplat.cli.main import parse
from snowsplat.pipeline.describe import describe
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.train import train
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.util.errors import UserError

SHORT = {"iterations": 2}


@pytest.fixture(scope="module")
def wrong(tmp_path_factory) -> Path:
    """A dataset whose focal length is in millimetres."""
    root = write_toy_dataset(tmp_path_factory.mktemp("wrong") / "mm", "colmap-txt", 9, 48, 36)
    cameras = root / "sparse" / "0" / "cameras.txt"
    lines = cameras.read_text().splitlines()
    changed = [re.sub(r"(PINHOLE 48 36) \S+ \S+", r"\1 4.2 4.2", line) for line in lines]
    assert changed != lines
    cameras.write_text("\n".join(changed) + "\n")
    return root


def test_refused(wrong: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(UserError, match=r"mm: .*field of view of 160°.*`trust_cameras`") as error:
        train(wrong, out, TrainOptions(settings=SHORT))
    assert "\n" not in str(error.value)
    assert not out.exists()


def test_trusted(wrong: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        result = train(wrong, tmp_path / "out", TrainOptions(settings=SHORT, trust_cameras=True))
    assert "field of view of 160°" in caplog.text
    assert "field of view of 160°" in result.report.read_text(encoding="utf-8")


def test_info(wrong: Path, tmp_path: Path) -> None:
    facts = describe(wrong)
    assert "field of view of 160°" in facts["impossible"][0]
    right = describe(write_toy_dataset(tmp_path / "right", "colmap-bin", 9, 48, 36))
    assert (right["impossible"], right["doubtful"]) == ([], [])


def test_flag() -> None:
    assert parse(["train", "garden", "-o", "out", "--trust-cameras"]).options.trust_cameras
