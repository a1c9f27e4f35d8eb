"""The tables beside this file: faults of the kernels, and faults without an effect."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomllib


@dataclass(frozen=True)
class Fault:
    """In a file of ``native/``, the text ``becomes`` replaces the text ``was``."""

    file: str  # relative to native/
    was: str
    becomes: str
    breaks: str  # what is wrong with the fault, for the report
    tests: str  # the tests that must detect it: a file of tests/ops, without test_ and .py


def _table(name: str) -> list[dict[str, Any]]:
    content = (Path(__file__).parent / f"{name}.toml").read_text(encoding="utf-8")
    entries: list[dict[str, Any]] = tomllib.loads(content)[name]
    return entries


#: Written by hand, with a description and the tests that must detect them.
FAULTS = tuple(Fault(**entry) for entry in _table("kernel_faults"))
#: (file in the package, lines before, lines after) -> why no test can detect the fault.
EQUIVALENTS = {
    (entry["file"], entry["was"], entry["becomes"]): entry["why"] for entry in _table("equivalents")
}
