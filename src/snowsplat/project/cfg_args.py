"""`cfg_args`: the settings of a training as ``Namespace(name=value, …)``, the format of the
reference implementation."""

import ast
from pathlib import Path
from typing import Any

_LIMIT = 1 << 16  # characters


def read_cfg_args(path: Path) -> dict[str, Any]:
    """Strings, numbers, True, False and None of ``Namespace(name=value, …)``; others are ignored.

    Nothing is executed.

    Raises:
        OSError: the file cannot be read.
        ValueError, SyntaxError: it is damaged.
    """
    with open(path, encoding="utf-8") as file:
        text = file.read(_LIMIT)
    try:
        call = ast.parse(text.strip(), mode="eval").body
    except (MemoryError, RecursionError):
        raise ValueError("nested too deeply") from None
    if not (isinstance(call, ast.Call) and getattr(call.func, "id", "") == "Namespace"):
        raise ValueError("not a Namespace")
    values = {}
    for keyword in call.keywords:
        try:
            value = ast.literal_eval(keyword.value)
        except (ValueError, TypeError):
            continue
        if keyword.arg and isinstance(value, str | int | float | None):
            values[keyword.arg] = value
    return values
