"""The sizes of the rooms: .ci/budget says the most that each may have.

A room that needs more says in the commit what it pays for, and changes its line there.
"""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def python_lines(folder: Path) -> int:
    return sum(len(file.read_bytes().splitlines()) for file in folder.rglob("*.py"))


def words(folder: Path) -> int:
    return sum(len(file.read_text(encoding="utf-8").split()) for file in folder.rglob("*.md"))


def budget() -> dict[str, int]:
    """Folder -> the most lines of Python, or words of Markdown for docs."""
    lines = (ROOT / ".ci" / "budget").read_text(encoding="utf-8").splitlines()
    entries = (line.partition("#")[0].split() for line in lines)
    return {name: int(most.replace(",", "")) for name, most in filter(None, entries)}


@pytest.mark.parametrize(("folder", "most"), budget().items())
def test_a_room_is_no_larger_than_its_budget(folder, most):
    count = words if folder == "docs" else python_lines
    found = count(ROOT / folder)
    assert found <= most, f"{folder} has {found:,}: make it smaller, or say what the rest pays for"
    assert found > 0.9 * most, f"{folder} has only {found:,}: lower its line in .ci/budget"


def test_every_room_has_a_budget():
    source = ROOT / "src" / "snowsplat"
    rooms = {
        f"src/snowsplat/{folder.name}" for folder in source.iterdir() if any(folder.rglob("*.py"))
    }
    assert rooms <= budget().keys()
    of_rooms = sum(most for name, most in budget().items() if name in rooms)
    assert of_rooms <= budget()["src"] + 500  # the rooms may not all be full
