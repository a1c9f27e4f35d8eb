"""The walk-throughs of docs/extend fit the code; at night, all of their commands are run."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

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


@pytest.mark.nightly
@pytest.mark.parametrize("walk", walk_throughs(), ids=lambda walk: walk.title)
def test_every_command_succeeds(tmp_path, walk):
    """In a copy of the files that git tracks, as they are in the working tree."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tmp_path / name)
    for built in ("src/snowsplat/_lib", "src/snowsplat/_viewer"):
        shutil.copytree(ROOT / built, tmp_path / built)
    walk.apply(tmp_path)
    # An editable installation adds a finder to `sys.meta_path`, which comes before PYTHONPATH.
    site = tmp_path / ".site"
    site.mkdir()
    (site / "sitecustomize.py").write_text(
        "import sys\n"
        "sys.meta_path[:] = [\n"
        '    f for f in sys.meta_path if not type(f).__module__.startswith("_editable_skbc_")\n'
        "]\n"
    )
    environment = {
        **os.environ,
        "PYTHON": sys.executable,
        "PYTHONPATH": os.pathsep.join([str(site), str(tmp_path / "src")]),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    for command in walk.commands:
        subprocess.run(command, shell=True, cwd=tmp_path, env=environment, check=True)
