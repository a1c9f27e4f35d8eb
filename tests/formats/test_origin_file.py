"""The place of a scene beside its file: a killed process leaves the old one or the new one."""

import contextlib
import itertools
import os

import pytest

from snowsplat.formats import read_gaussians, write_gaussians
from snowsplat.formats.origin_file import Place, origin_file, read_place

OLD, NEW = (500_000.0, 20.0, -5_400_000.0), (1000.0, 2000.5, -3.0)
NONE = (0.0, 0.0, 0.0)


class Killed(BaseException):
    """In place of a signal: nothing more is written."""


@pytest.mark.parametrize(("before", "after"), [(OLD, NEW), (NONE, NEW), (OLD, NONE)])
@pytest.mark.parametrize("suffix", [".spz", ".splat"])
def test_processes_killed_at_any_write(tmp_path, make_scene, monkeypatch, before, after, suffix):
    """Also a second process, which does what the first one did."""
    path, replace, seen = tmp_path / f"a{suffix}", os.replace, set()
    old, new = make_scene(5, 0), make_scene(7, 0)
    old.origin, new.origin, new.metres_per_unit = before, after, 0.5 if after == NEW else None

    def write_killed_at(change: int) -> None:
        left = iter(range(change))

        def replacing(one, other):
            if next(left, None) is None:
                raise Killed
            replace(one, other)

        with monkeypatch.context() as patched, contextlib.suppress(Killed):
            patched.setattr(os, "replace", replacing)
            write_gaussians(path, new)
        found = read_gaussians(path)
        seen.add((len(found), found.origin, found.metres_per_unit))

    for first, second in itertools.product(range(4), range(4)):
        write_gaussians(path, old)
        write_killed_at(first)
        write_killed_at(second)
    assert seen == {(5, before, None), (7, after, new.metres_per_unit)}
    write_gaussians(path, new)
    assert (read_gaussians(path).origin, origin_file(path).exists()) == (after, after != NONE)


def test_the_place_that_was_announced_for_another_file(tmp_path):
    """A copy with another time has the place that the complete file had."""
    (tmp_path / "a.spz").write_bytes(b"12345")
    text = '{"origin": [1, 2, 3], "next": {"origin": [4, 5, 6], "of": [5, 6]}}'
    origin_file(tmp_path / "a.spz").write_text(text)
    assert read_place(tmp_path / "a.spz") == Place((1.0, 2.0, 3.0))
    os.utime(tmp_path / "a.spz", ns=(6, 6))
    assert read_place(tmp_path / "a.spz") == Place((4.0, 5.0, 6.0))
