"""The walk-throughs of CONTRIBUTING.md fit the code. nightly/try_walk_throughs.py follows them."""

import re
import shutil

import pytest

from .walk_throughs import ROOT, Mismatch, WalkThrough, patched, walk_throughs

TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_there_are_four_walk_throughs():
    titles = [walk.title for walk in walk_throughs(TEXT)]
    assert titles == [
        "Add a scene format",
        "Add a loss",
        "Add a density control",
        "Add an operation",
    ]


@pytest.mark.parametrize("walk", walk_throughs(TEXT), ids=lambda walk: walk.title)
def test_every_change_applies_to_the_present_code(tmp_path, walk):
    assert walk.commands
    for name, kind, _ in walk.edits:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "diff" and not path.exists():
            shutil.copyfile(ROOT / name, path)
        else:
            assert not (ROOT / name).exists(), name
    walk.apply(tmp_path)
    for name, kind, _ in walk.edits:
        if kind == "python":
            text = (tmp_path / name).read_text(encoding="utf-8")
            compile(text, name, "exec")
            assert max(map(len, text.splitlines())) <= 100, name


def test_files_named_exist():
    prose = re.sub(r"^```.*?^```$", "", TEXT, flags=re.MULTILINE | re.DOTALL)
    links = re.findall(r"\]\(([^):#]+)", prose)
    assert links
    for link in links:
        assert (ROOT / link).exists(), link


def test_a_change_that_does_not_fit_is_an_error():
    with pytest.raises(Mismatch, match="occur 0 times"):
        patched("a", "x = 1\ny = 2\n", "-x = 2\n")
    with pytest.raises(Mismatch, match="occur 2 times"):
        patched("a", "x\nx\n", " x\n+y\n")
    assert patched("a", "x\n\ny\nz\n", " x\n\n-y\n+w\n@@\n z\n+v\n") == "x\n\nw\nz\nv\n"
    with pytest.raises(Mismatch, match="no file is named"):
        walk_throughs("## Add it\n\nCreate this:\n\n```python\nx\n```\n")


def test_a_new_file_must_be_new(tmp_path):
    walk = WalkThrough("Add it", [("a.py", "python", "x = 1\n")])
    walk.apply(tmp_path)
    with pytest.raises(Mismatch, match="exists already"):
        walk.apply(tmp_path)
