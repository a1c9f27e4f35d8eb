"""Files are whole or absent, and what a kill leaves beside them can be told and removed."""

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
from snowsplat.util.files import atomic_path, remove_temporaries, write_json, write_text

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(snowsplat.__file__).parents[1])}


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
    mine = (".other.json.abcdefgh.tmp", ".other.json.tmp", ".job.json.bak", "job.json", "a.tmp")
    for name in (".job.json.abcd_123.tmp", *mine):
        (tmp_path / name).write_text("")
    remove_temporaries(tmp_path, ["job.json"])
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(mine)


def test_the_next_write_takes_what_a_kill_left(tmp_path):
    program = """
import os, sys
from snowsplat.util.files import atomic_path
with atomic_path(sys.argv[1]) as temporary:
    temporary.write_text("a part that is longer than the whole")
    os._exit(9)
"""
    target = tmp_path / "scene.spz"
    for _ in range(3):
        done = subprocess.run([sys.executable, "-c", program, target], env=ENVIRONMENT, check=False)
        assert done.returncode == 9
        assert len(list(tmp_path.iterdir())) == 1
    write_text(target, "whole")
    assert [path.name for path in tmp_path.iterdir()] == ["scene.spz"]
    assert target.read_text() == "whole"


def test_writers_of_one_file_do_not_meet(tmp_path):
    target = tmp_path / "a.txt"
    whole = {letter * 100_000 for letter in "abcd"}
    seen = set()

    def write(text):
        for _ in range(50):
            write_text(target, text)

    with ThreadPoolExecutor(4) as pool:
        running = [pool.submit(write, text) for text in whole]
        while not all(future.done() for future in running):
            if target.exists():
                seen.add(target.read_text())
        for future in running:
            future.result()
    assert seen <= whole
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_an_error_names_the_file_that_was_asked_for(tmp_path):
    with pytest.raises(FileNotFoundError) as absent:
        write_text(tmp_path / "absent" / "a.txt", "x")
    assert absent.value.filename == str(tmp_path / "absent" / "a.txt")

    def full():
        with atomic_path(tmp_path / "a.txt"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # as a write says it

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
