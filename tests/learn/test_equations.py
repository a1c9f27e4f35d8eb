"""The map of docs/learn/equations.md."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def functions(file: Path) -> set[str]:
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".py":
        kinds = (ast.FunctionDef, ast.ClassDef)
        return {node.name for node in ast.walk(ast.parse(text)) if isinstance(node, kinds)}
    return set(re.findall(r"\b(\w+)\(", text))


def test_every_function_of_the_map_exists():
    rows = (ROOT / "docs" / "learn" / "equations.md").read_text("utf-8").splitlines()
    checked = 0
    for row in rows:
        found = re.search(r"`([\w/]+\.(?:py|h))`(.*)$", row) if row.startswith("| ") else None
        if found is None:
            continue
        names = re.findall(r"`(\w+)`", found[2])
        assert names, row
        missing = set(names) - functions(ROOT / "src" / "snowsplat" / found[1])
        assert not missing, row
        checked += 1
    assert checked >= 25
