"""A training refuses impossible cameras before it writes anything, unless they are trusted."""

import logging
import re
from dataclasses import replace
from pathlib import Path

import pytest

from snowsplat.cli.main import parse
from snowsplat.data import load_dataset, read_dataset
from snowsplat.data.judge.lens_check import Finding
from snowsplat.pipeline.describe import describe
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.run import dataset_check
from snowsplat.pipeline.train import train
from snowsplat.project.training_folder import TrainingFolder
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
    assert "field of view of 160°" in str(facts["impossible"][0])
    right = describe(write_toy_dataset(tmp_path / "right", "colmap-bin", 9, 48, 36))
    assert (right["impossible"], right["doubtful"]) == ([], [])


def test_flag() -> None:
    assert parse(["train", "garden", "-o", "out", "--trust-cameras"]).options.trust_cameras


def test_photos_whose_poses_are_contradicted_are_left_out(tmp_path, monkeypatch, caplog) -> None:
    """Of the training, and of what reads the dataset after it."""
    dataset = write_toy_dataset(tmp_path / "toy", "colmap-bin", 9, 48, 36)
    names = ("view_03.png", "view_08.png")
    found = Finding("poses", "the poses of two are wrong", photos=names)
    everything = {v.name for v in load_dataset(dataset, hold_out=None).train}
    assert {*names} < everything
    monkeypatch.setattr(dataset_check, "judge", lambda dataset: [found])
    options = TrainOptions(settings=SHORT, hold_out=8)
    result = train(dataset, tmp_path / "out", options)
    assert [(each.photo, each.stage) for each in result.left_out] == [(n, "poses") for n in names]
    folder = TrainingFolder(tmp_path / "out")
    assert {each.photo for each in folder.left_out()} == {*names}
    again = read_dataset(folder.settings()[0])
    assert {view.name for view in [*again.train, *again.test]} == everything - {*names}
    trusted = train(dataset, tmp_path / "trusted", replace(options, trust_cameras=True))
    assert trusted.left_out == ()
