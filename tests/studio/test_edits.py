"""The modules of the editor: what a shape and the box select, and what undoes a change."""

import base64
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="needs node")

COUNT = 77
QUARTER = [0.5**0.5, 0.0, 0.5**0.5, 0.0]  # 90° about y
NOTE = {"title": "A", "text": "", "view": [0.1, 0.2, 0.3, 0, 0, 0, 40, 1.5]}


def asked(**more: Any) -> dict[str, Any]:
    """What the modules answer; without a call, of an empty scene."""
    empty: dict[str, Any] = {
        "count": COUNT,
        "calls": [],
        "centers": [],
        "matrix": np.eye(4).reshape(-1).tolist(),
        "shape": [],
        "width": 8,
        "height": 6,
        "box": [[0, 0, 0], [1, 1, 1]],
        "floor": [],
        "eye": [0, 0, 0],
    }
    script = Path(__file__).parents[1] / "node" / "selection.mjs"
    words = json.dumps(empty | more)
    done = subprocess.run(["node", script], input=words, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def random_calls(random: np.random.Generator, count: int) -> list[list[Any]]:
    def found() -> list[int]:
        return random.integers(0, 2, COUNT).tolist()

    def typed(k: int) -> list[Any]:
        return ["change", {"notes": [NOTE | {"title": "A" * k}]}, "title 0"]

    def dragged() -> list[Any]:
        return ["change", {"box": random.normal(size=(2, 3)).tolist()}, "box 1"]

    makers = [
        lambda: ["select", found(), "replace"],
        lambda: ["select", found(), "add"],
        lambda: ["select", found(), "remove"],
        lambda: ["invert"],
        lambda: ["delete"],
        lambda: ["turnBy", QUARTER],
        lambda: ["turnBy", [0.8, 0.6, 0.0, 0.0]],
        lambda: ["change", {"scale": random.uniform()}],
        lambda: ["change", {"start": random.normal(size=8).tolist()}],
        *[lambda: typed(int(random.integers(1, 9)))] * 3,
        *[dragged] * 3,
        *[lambda: ["undo"]] * 4,
        *[lambda: ["redo"]] * 3,
    ]
    return [makers[random.integers(len(makers))]() for _ in range(count)]


def test_undo_and_redo_return_the_same_bits():
    """All operations, in a random sequence: each undo returns exactly what was before the step."""
    calls = [*random_calls(np.random.default_rng(3), 400), *[["undo"]] * 60, *[["redo"]] * 60]
    steps = asked(calls=calls)["steps"]
    present: dict[str, Any] = {"state": [0] * COUNT, "turn": [1, 0, 0, 0], "scale": 1}
    present |= {"start": None, "notes": [], "box": []}
    past, future = [], []
    typing = None  # the name of a step that goes on
    undone = redone = 0
    for call, found in zip(calls, steps, strict=True):
        if call[0] in ("undo", "redo"):
            back, forth = (past, future) if call[0] == "undo" else (future, past)
            if back:
                forth.append(present)
                present = back.pop()
                undone, redone = undone + (call[0] == "undo"), redone + (call[0] == "redo")
                typing = None
            assert found == present
        elif found != present or call[0] == "change":
            named = call[2] if call[0] == "change" and len(call) == 3 else None
            if named is None or named != typing:
                past = [*past, present][-40:]
            future.clear()
            typing = named
            present = found
    assert (undone, redone) > (50, 20)


def test_what_is_selected_and_undone():
    random = np.random.default_rng(0)
    count = COUNT
    found = [random.integers(0, 2, count).tolist() for _ in range(3)]
    floor, eye = [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 2.0]], [-1.0, 3.0, 0.5]
    calls = [
        ["select", found[0], "replace"],
        ["select", found[1], "add"],
        ["delete"],
        ["select", found[2], "replace"],
        ["invert"],
        ["select", found[0], "remove"],
        *[["undo"]] * 6,
        *[["redo"]] * 6,
        ["undo"],
        ["select", found[0], "remove"],  # the same as before: the future is another one
        ["redo"],
        ["turnBy", QUARTER],
        ["turnBy", QUARTER],
        ["undo"],
        ["undo"],
        ["redo"],
    ]
    centers = random.normal(size=(count, 3))
    matrix = random.normal(size=(4, 4))
    shape = random.integers(0, 2, (6, 8))
    box = [[-0.5, -1.0, -0.2], [1.0, 0.4, 2.0]]
    answer = asked(
        calls=calls,
        centers=centers.reshape(-1).tolist(),
        matrix=matrix.T.reshape(-1).tolist(),
        shape=shape.reshape(-1).tolist(),
        box=box,
        floor=floor,
        eye=eye,
    )
    states = [step["state"] for step in answer["steps"]]
    turns = [step["turn"] for step in answer["steps"]]
    a, b, c = (np.array(each) for each in found)
    deleted = a | b
    assert states[0] == a.tolist()
    assert states[1] == deleted.tolist()
    assert states[2] == (2 * deleted).tolist()
    assert states[3] == np.where(deleted, 2, c).tolist()
    assert states[4] == np.where(deleted, 2, 1 - c).tolist()
    assert states[5] == np.where(deleted, 2, (1 - c) & (1 - a)).tolist() == states[4]
    # The last call changed nothing: it is no step. So the sixth undo has nothing left.
    assert states[6:12] == [*states[3::-1], [0] * count, [0] * count]
    assert states[12:18] == [*states[:5], states[4]]
    assert states[18:21] == [states[3], states[3], states[4]]
    assert states[21:] == 5 * [states[4]]
    straight, once, twice = turns[20:23]
    assert (straight, once) == ([1, 0, 0, 0], QUARTER)
    assert np.allclose(twice, [0, 0, 1, 0])
    assert turns[23:] == [once, straight, once]  # the same bits
    level = np.array(answer["level"])
    assert np.ptp(level[:, 1]) < 1e-12
    assert level[0, 1] < eye[1]  # the eye is above
    counts = np.bincount(states[-1], minlength=3).tolist()
    assert answer["counts"] == counts
    bits = np.frombuffer(base64.b64decode(answer["deleted"]), np.uint8)
    assert np.unpackbits(bits, bitorder="little")[:count].tolist() == deleted.tolist()
    clip = np.float32(centers) @ matrix[:, :3].T + matrix[:, 3]
    column, row = (clip[:, 0] / clip[:, 3] + 1) * 4, (1 - clip[:, 1] / clip[:, 3]) * 3
    inside = (clip[:, 3] > 0) & (column >= 0) & (column < 8) & (row >= 0) & (row < 6)
    expected = [
        int(i and shape[int(r), int(c)]) for i, r, c in zip(inside, row, column, strict=True)
    ]
    assert answer["found"] == expected
    beyond = (np.float32(centers) < box[0]) | (np.float32(centers) > box[1])
    assert answer["outside"] == beyond.any(1).astype(int).tolist()


def test_the_point_of_an_axis_that_is_nearest_to_the_pointer():
    """A perspective view along z, 90° wide, from the origin; y is up."""
    matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, -0.2], [0, 0, -1, 0]]
    point = [0.5, -0.25, -2.0]
    exact = [
        {"point": point, "axis": axis, "length": 1, "to": to}
        for axis, to in ((0, 2.0), (0, -1.5), (1, 3.0), (2, -9.0), (2, -0.3))
    ]
    away = {"point": point, "axis": 0, "length": 1, "place": [5.0, 1.0]}  # beside the axis
    end = {"point": [0.0, 0.0, -2.0], "axis": 2, "length": 1, "place": [5.0, 1.0]}
    beyond = {"point": point, "axis": 2, "length": 100, "place": [399, 301]}  # its vanishing point
    behind = {"point": [0.0, 0.0, 2.0], "axis": 0, "length": 1, "place": [5.0, 1.0]}
    columns = np.array(matrix, float).T.reshape(-1).tolist()
    drags = asked(matrix=columns, width=800, height=600, drags=[*exact, away, end, beyond, behind])
    moved = [each["to"] - point[each["axis"]] for each in exact]
    assert np.allclose(drags["drags"][:5], moved)
    # The window shows x / −z: column 5 of 800 is −0.9875 at any height.
    assert drags["drags"][5] == pytest.approx(2 * (5 / 400 - 1) - 0.5)
    assert drags["drags"][6:] == [None, None, None]
