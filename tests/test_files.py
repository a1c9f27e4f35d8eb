"""Files are whole or absent, and what a kill leaves beside them can be told and removed."""

import json
import math
import os
import stat

import pytest

from snowsplat.files import atomic_path, remove_temporaries, write_json, write_text


def interrupted_write(path):
    with atomic_path(path) as temporary:
        temporary.write_text("a par")
        raise KeyboardInterrupt(temporary.name)


def test_a_failure_leaves_the_old_file_and_nothing_beside_it(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(KeyboardInterrupt):
        interrupted_write(tmp_path / "a.txt")
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_files_are_for_others_to_read_as_any_file_is(tmp_path):
    mask = os.umask(0o022)
    try:
        write_text(tmp_path / "a.txt", "x")
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == 0o644


def test_json_knows_no_infinity(tmp_path):
    write_json(tmp_path / "a.json", {"a": [math.inf, (math.nan, 1.5)]})
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": [None, [None, 1.5]]}


def test_what_a_kill_left_is_removed_and_nothing_else(tmp_path):
    with pytest.raises(KeyboardInterrupt) as caught:
        interrupted_write(tmp_path / "job.json")
    # As if the process had been killed before it could remove it.
    (tmp_path / str(caught.value)).write_text("a par")
    for name in (".other.json.abcdefgh.tmp", ".job.json.tmp", "job.json"):
        (tmp_path / name).write_text("")
    remove_temporaries(tmp_path, ["job.json"])
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        ".job.json.tmp",
        ".other.json.abcdefgh.tmp",
        "job.json",
    ]
