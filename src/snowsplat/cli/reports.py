"""`--json`: the result of a subcommand as JSON on stdout, and all other lines on stderr."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from snowsplat.cli.flags import switch

JsonFlag: TypeAlias = Annotated[
    bool, switch(help="Print the result as JSON on stdout, and everything else on stderr.")
]


class Reports:
    """A subcommand with the flag ``json``, whose `run` puts its result into ``report``."""

    json: bool
    report: Any = None

    def run(self) -> int:
        """Run the subcommand; returns its exit code."""
        raise NotImplementedError


def run(command: Any) -> int:
    """Run a subcommand; returns its exit code.

    With ``json``, stdout gets one JSON value, or nothing if there is no result.
    """
    if not isinstance(command, Reports) or not command.json:
        return int(command.run())
    with redirect_stdout(sys.stderr):
        code = int(command.run())
    if command.report is not None:
        print(json.dumps(plain(command.report), indent=2, allow_nan=False), flush=True)
    return code


def plain(value: Any) -> Any:
    """A value of JSON: dataclasses are objects, paths are texts, and numbers that are not finite
    are null."""
    if hasattr(value, "as_json"):
        return plain(value.as_json())
    if is_dataclass(value):
        return {each.name: plain(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
