"""Files are complete or missing; temporary files of killed writers are recognised and removed."""

import errno
import json
import math
import os
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import snowsplat
from snowsplat.util import files
from snowsplat.util.errors import UserError
from snowsplat.util.files import (
    atomic_path,
    new_entries,
    new_folder,
    remove_temporaries,
    write_json,
    write_text,
)

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(snowsplat.__file__).parents[1])}


def interrupted_write(path):
    with atomic_path(path) as temporary:
        temporary.write_text("a par")
        raise KeyboardInterrupt(temporary.name)


def test_a_failure_leaves_only_the_old_file(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(KeyboardInterrupt):
        interrupted_write(tmp_path / "a.txt")
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_files_have_the_default_permissions(tmp_path):
    mask = os.umask(0o022)
    try:
        write_text(tmp_path / "a.txt", "x")
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == 0o644


def test_a_private_file_is_not_one_that_another_user_has_prepared(tmp_path):
    prepared = tmp_path / ".secret.tmp"
    prepared.touch(mode=0o666)
    with atomic_path(tmp_path / "secret", private=True) as temporary:
        temporary.write_text("secret")
    assert (tmp_path / "secret").read_text() == "secret"
    assert (tmp_path / "secret").stat().st_mode & 0o77 == 0
    assert prepared.read_text() == ""


def test_json_has_null_for_infinity_and_nan(tmp_path):
    write_json(tmp_path / "a.json", {"a": [math.inf, (math.nan, 1.5)]})
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": [None, [None, 1.5]]}


def test_only_temporary_files_of_killed_writers_are_removed(tmp_path):
    with pytest.raises(KeyboardInterrupt) as caught:
        interrupted_write(tmp_path / "job.json")
    # Restore the temporary file, as if the process had been killed before it could remove it.
    (tmp_path / str(caught.value)).write_text("a par")
    others = (".other.json.abcdefgh.tmp", ".other.json.tmp", ".job.json.bak", "job.json", "a.tmp")
    for name in (".job.json.abcd_123.tmp", *others):
        (tmp_path / name).write_text("")
    remove_temporaries(tmp_path, ["job.json"])
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(others)


def test_the_next_write_reuses_the_temporary_file_of_a_killed_writer(tmp_path):
    program = """
import os, sys
from snowsplat.util.files import atomic_path
with atomic_path(sys.argv[1]) as temporary:
    temporary.write_text("a part that is longer than the complete file")
    os._exit(9)
"""
    target = tmp_path / "scene.spz"
    for _ in range(3):
        done = subprocess.run([sys.executable, "-c", program, target], env=ENVIRONMENT, check=False)
        assert done.returncode == 9
        assert len(list(tmp_path.iterdir())) == 1
    write_text(target, "complete")
    assert [path.name for path in tmp_path.iterdir()] == ["scene.spz"]
    assert target.read_text() == "complete"


def test_concurrent_writers_of_one_file_do_not_interfere(tmp_path):
    target = tmp_path / "a.txt"
    complete = {letter * 100_000 for letter in "abcd"}
    seen = set()

    def write(text):
        for _ in range(50):
            write_text(target, text)

    with ThreadPoolExecutor(4) as pool:
        running = [pool.submit(write, text) for text in complete]
        while not all(future.done() for future in running):
            if target.exists():
                seen.add(target.read_text())
        for future in running:
            future.result()
    assert seen <= complete
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_errors_name_the_target_and_not_the_temporary_file(tmp_path):
    with pytest.raises(FileNotFoundError) as absent:
        write_text(tmp_path / "absent" / "a.txt", "x")
    assert absent.value.filename == str(tmp_path / "absent" / "a.txt")

    def full():
        with atomic_path(tmp_path / "a.txt"):
            raise OSError(
                errno.ENOSPC, os.strerror(errno.ENOSPC)
            )  # as a write raises it, without a name

    with pytest.raises(OSError, match="a.txt") as caught:
        full()
    assert caught.value.filename == str(tmp_path / "a.txt")

    def other():
        with atomic_path(tmp_path / "a.txt"):
            (tmp_path / "input.txt").read_text()

    with pytest.raises(FileNotFoundError) as caught:
        other()
    assert caught.value.filename == str(tmp_path / "input.txt")
    assert not list(tmp_path.iterdir())


def test_a_new_folder_is_empty_and_removed(tmp_path):
    path = tmp_path / "new"
    path.mkdir()
    (path / "left by a killed process").touch()
    with new_folder(path) as folder:
        assert folder == path
        assert not list(folder.iterdir())
        with new_folder(path) as other:  # as in another process
            (other / "a").touch()
        assert not list(folder.iterdir())
    assert not list(tmp_path.iterdir())


def test_a_link_in_the_place_of_a_new_folder_is_not_followed(tmp_path):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs/file").touch()
    (tmp_path / "new").symlink_to(tmp_path / "theirs")
    with new_folder(tmp_path / "new") as folder:
        assert folder != tmp_path / "new"
    assert (tmp_path / "theirs/file").exists()


@pytest.fixture
def entries(tmp_path):
    """A folder with ``a/old``, ``b/old``, the file ``c`` and a file of somebody else."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "old").touch()
    (tmp_path / "c").write_text("old")
    (tmp_path / "foreign").touch()
    return tmp_path


def write_new(new):
    (new / "a").mkdir()
    (new / "a/new").touch()
    (new / "c").write_text("new")


def contents(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("exchanges", [True, False])
def test_entries_are_replaced_at_the_end(entries, monkeypatch, exchanges):
    if not exchanges:  # as on Windows
        monkeypatch.setattr(files, "_exchanged", lambda one, other: False)
    with new_entries(entries, ["a", "b", "c"]) as new:
        write_new(new)
        assert contents(entries) == {"a/old", "b/old", "c", "foreign", *staged(new, entries)}
    assert contents(entries) == {"a/new", "c", "foreign"}
    assert (entries / "c").read_text() == "new"
    assert {path.name for path in entries.iterdir()} == {"a", "c", "foreign"}


def staged(new, folder):
    return {str(path.relative_to(folder)) for path in new.rglob("*") if path.is_file()}


def replace(folder, names, write):
    with new_entries(folder, names) as new:
        write(new)


def test_a_failure_replaces_no_entry(entries):
    def fail(new):
        write_new(new)
        raise OSError(errno.ENOSPC, "the disk is full")

    with pytest.raises(OSError, match="full"):
        replace(entries, ["a", "b", "c"], fail)
    assert contents(entries) == {"a/old", "b/old", "c", "foreign"}


def test_files_links_and_folders_replace_each_other(entries):
    (entries / "link").symlink_to(entries / "b")
    with new_entries(entries, ["c", "a", "link"]) as new:
        (new / "c").mkdir()
        (new / "c/new").touch()
        (new / "a").write_text("a file")
        (new / "link").mkdir()
    assert contents(entries) == {"c/new", "a", "b/old", "foreign"}
    assert not (entries / "link").is_symlink()


def test_entries_that_must_not_be_written_stay(entries, monkeypatch):
    """Somebody else has taken the lock while the new ones were written."""
    lost = []

    def check(path):
        if lost:
            raise UserError("lost")

    monkeypatch.setattr(files, "CHECKS", [check])
    with pytest.raises(UserError, match="lost"):
        replace(entries, ["a", "c"], lambda new: (write_new(new), lost.append(True)))
    assert contents(entries) == {"a/old", "b/old", "c", "foreign"}


def test_the_last_entry_is_absent_while_the_others_are_replaced(entries, monkeypatch):
    """It shows that they belong together, so a kill in between leaves nothing mixed."""
    seen = []
    monkeypatch.setattr(files, "_exchanged", lambda *_: seen.append((entries / "c").exists()))
    with new_entries(entries, ["a", "b", "c"]) as new:
        write_new(new)
    assert seen == [False]
