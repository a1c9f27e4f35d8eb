"""The walk-throughs of docs/extend fit the code. nightly/try_walk_throughs.py follows them."""

import shutil

import pytest

from .walk_throughs import FOLDER, ROOT, walk_throughs


def test_every_page_is_a_walk_through_except_for_the_index():
    assert len(walk_throughs()) == len(list(FOLDER.glob("*.md"))) - 1 >= 4


@pytest.mark.parametrize("walk", walk_throughs(), ids=lambda walk: walk.title)
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
