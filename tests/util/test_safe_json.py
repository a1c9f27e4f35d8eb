"""Untrusted JSON, names and values."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest

from snowsplat.util.safe_json import from_json, inside, is_file, parse_json, quoted, read_json


@dataclass(frozen=True)
class Inner:
    name: str
    when: int | float = 0


@dataclass(frozen=True)
class Outer:
    count: int
    share: float
    kind: Literal["a", "b"] = "a"
    place: tuple[float, float] | None = None
    steps: tuple[int, ...] = ()
    inner: Inner | None = None
    counts: dict[str, int] | None = None
    parts: list[Inner] | None = None
    rest: Any = None
    on: bool = False


def test_a_dataclass_is_restored():
    values = {
        "count": 3,
        "share": 1,
        "kind": "b",
        "place": [1, 2.5],
        "steps": [1, 2, 3],
        "on": True,
        "inner": {"name": "x", "when": 0.5},
        "counts": {"a": 1},
        "parts": [{"name": "y"}],
        "rest": [None, {"z": 1}],
    }
    made = from_json(Outer, values)
    inner, parts = Inner("x", 0.5), [Inner("y")]
    expected = Outer(3, 1, "b", (1, 2.5), (1, 2, 3), inner, {"a": 1}, parts, [None, {"z": 1}], True)
    assert made == expected
    assert isinstance(
        from_json(Inner, {"name": "x", "when": 1}).when, int
    )  # not converted to float


@pytest.mark.parametrize(
    "changed",
    [
        *({"count": value} for value in (1.0, True, "1", None, [1], 10**400, -(2**64))),
        *({"share": value} for value in ("1", None, True, float("nan"), float("inf"), 10**400)),
        *({"kind": value} for value in ("c", 1, None, ["a"])),
        *({"place": value} for value in ([1], [1, 2, 3], "ab", {"a": 1})),
        *({"steps": value} for value in (1, "12", [1.5], [[1]])),
        *({"inner": value} for value in ({}, {"name": 1}, {"name": "x", "more": 1}, [], "x")),
        *({"counts": value} for value in ({"a": "b"}, [], 1)),
        *({"parts": value} for value in ([{}], [None], {"name": "y"})),
        {"on": 1},
        {"more": 1},
    ],
)
def test_values_of_another_type_are_rejected(changed):
    with pytest.raises(ValueError):  # noqa: PT011 (callers write their own messages)
        from_json(Outer, {"count": 1, "share": 0.5, **changed})


def test_values_that_are_not_objects_or_incomplete_are_rejected():
    for values in (None, [], "x", 3, {"count": 1}):
        with pytest.raises(ValueError):  # noqa: PT011
            from_json(Outer, values)


def test_json_with_and_without_byte_order_mark():
    for mark in (b"", b"\xef\xbb\xbf"):
        assert parse_json(mark + '{"é": [1, 2.5, null]}'.encode()) == {"é": [1, 2.5, None]}


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{",
        b"\xff",
        b"[" * 10**6,
        b"[" * 500 + b"]" * 500,
        b'{"a":' * 10**5,
        b"9" * 5000,
        b"[" + b"[]," * 10**7 + b"0]",
    ],
)
def test_invalid_json_is_rejected(data):
    with pytest.raises(ValueError):  # noqa: PT011
        parse_json(data)


def test_json_may_be_a_single_value():
    assert [parse_json(data) for data in (b"3", b'"a"', b"null", b"[]")] == [3, "a", None, []]


def test_large_json_of_programs_is_accepted():
    """A dataset with 20,000 photos, written without spaces."""
    pose = [[round(0.123456 * i * k, 6) for i in range(4)] for k in range(4)]
    frame = json.dumps({"file_path": "images/frame_00001.jpg", "transform_matrix": pose})
    data = b'{"frames": [' + b",".join([frame.encode()] * 20_000) + b"]}"
    assert len(parse_json(data)["frames"]) == 20_000


def test_a_pipe_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "a.json")
    with pytest.raises(ValueError, match="not a file"):
        read_json(tmp_path / "a.json")
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "absent.json")


def test_names_inside_and_outside_a_folder(tmp_path):
    for name in ("a", "a/b.png", "./a", "a/../b", str(tmp_path / "a"), "..a", "a..b"):
        assert inside(tmp_path, name) == tmp_path / name
    for name in (
        "..",
        "../a",
        "a/../../b",
        "/etc/passwd",
        str(tmp_path) + "x/a",
        "a\0b",
        "x" * 256,
    ):
        assert inside(tmp_path, name) is None


def test_names_in_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert inside(Path(), "a") == Path("a")
    assert inside(Path(), "../a") is None


def test_is_file(tmp_path):
    (tmp_path / "a").write_text("")
    os.mkfifo(tmp_path / "pipe")
    names = ("a", "pipe", "absent", ".", "a\0", "x" * 5000)
    assert [is_file(tmp_path / name) for name in names] == [True] + [False] * 5
    assert not is_file(Path("/dev/zero"))


def test_quoted_values_are_short_and_without_control_characters():
    assert quoted("a'b") == '"a\'b"'
    assert quoted("\x1b[2J\udcd8") == "'\ufffd[2J?'"
    assert len(quoted("\udcd8\x00" * 1000)) <= 82
    assert quoted(7) == "'7'"
