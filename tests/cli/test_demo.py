"""`snowsplat demo`: its output, a repeated run, wrong poses, folders that are refused."""

import functools
from dataclasses import replace
from pathlib import Path

import pytest

import snowsplat.synthetic
from snowsplat.cli import view
from snowsplat.formats import read_gaussians
from snowsplat.pipeline import demo
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options.make import PRESETS, MakeOptions

from ..scenes.coarse import coarse_still_life


@pytest.fixture
def small(monkeypatch) -> None:
    """Few small photos and few steps, and limits that suit them."""
    photos = functools.partial(
        snowsplat.synthetic.write_synthetic_photos, n_views=14, width=320, height=240
    )
    monkeypatch.setattr(demo, "write_synthetic_photos", photos)
    coarse_still_life(monkeypatch, 2.0)
    monkeypatch.setitem(PRESETS, "draft", replace(PRESETS["draft"], iterations=30))
    monkeypatch.setattr(demo, "_OPTIONS", MakeOptions("draft", compute=Compute(threads=1)))
    monkeypatch.setattr(demo, "MAX_DEGREES", 3.0)
    monkeypatch.setattr(demo, "MAX_SHARE", 0.03)


@pytest.mark.sfm
def test_from_nothing_to_a_scene(run, small, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = run("demo")
    assert first.code == 0, first.err
    out = Path("snowsplat_demo")
    assert len(list((out / "photos").glob("*.jpg"))) == 14
    assert (out / "truth" / "images.txt").is_file()
    assert len(read_gaussians(out / "made" / "photos.ply")) > 100
    assert "(14 of 14 photos)" in first.out
    assert first.out.splitlines()[-2:] == [
        "to see it: snowsplat view snowsplat_demo/made; "
        "to share it: snowsplat publish snowsplat_demo/made -o made_site",
        "with your own photos: snowsplat make PHOTOS",
    ]

    # All stages are finished. With --open, the scene is shown as by `view`.
    shown = []
    monkeypatch.setattr(view.View, "run", lambda self: shown.append(self.path) or 0)
    again = run("demo", "--open")
    assert again.code == 0, again.err
    assert again.out.count("done before") == 8
    assert shown == [out / "made"]

    monkeypatch.setattr(demo, "MAX_DEGREES", 1e-9)
    wrong = run("demo", "--open")
    assert wrong.code == 1
    assert wrong.err.startswith("snowsplat: the camera poses are wrong; ")
    assert len(wrong.err.splitlines()) == len(shown) == 1


def test_other_files_are_refused(refused, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    assert "contains other files; use a new" in refused("demo", "-o", tmp_path)
    assert "is a file" in refused("demo", "-o", tmp_path / "mine.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_after_ctrl_c_the_command_that_resumes_is_printed(run, tmp_path, monkeypatch):
    def interrupted(folder, report):
        raise KeyboardInterrupt

    monkeypatch.setattr(demo, "write_synthetic_photos", interrupted)
    stopped = run("demo", "-o", tmp_path / "a b", "--open")
    assert stopped.code == 130
    assert stopped.out.splitlines()[-1] == (
        f"resume with: snowsplat demo --output '{tmp_path / 'a b'}' --open"
    )
