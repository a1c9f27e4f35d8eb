"""`cfg_args`: the settings of a training as ``Namespace(name=value, …)``, the format of the
reference implementation."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

# _WORD: a string, a name, a number, or a single character. _LITERAL: a literal whose value is used.
# An expression that matches spaces would take quadratic time for a file with a million of them.
_WORD = re.compile(r"""'(?:[^'\\]|\\.)*'|"(?:[^"\\]|\\.)*"|[\w.+-]+|\S""", re.DOTALL)
_LITERAL = re.compile(r"""['"].*['"]|True|False|None|-?[\d.]+(?:e[+-]?\d+)?""", re.DOTALL)
_LIMIT = 1 << 20  # characters
# So many words of an argument of Namespace are kept: NAME = VALUE, and one more if it is longer.
_STORED_WORDS = 4


def read_cfg_args(path: Path) -> dict[str, Any]:
    """Strings, numbers, True, False and None of ``Namespace(name=value, …)``; others are ignored.

    Only single words are passed to `ast.literal_eval`: it executes nothing, but deep nesting may
    crash the interpreter.

    Raises:
        OSError: the file cannot be read.
        ValueError, SyntaxError: it is damaged.
    """
    with open(path, encoding="utf-8") as file:
        words = (match[0] for match in _WORD.finditer(file.read(_LIMIT)))
        if [next(words, ""), next(words, "")] != ["Namespace", "("]:
            raise ValueError("not a Namespace")
        values, depth, part = {}, 1, list[str]()
        for word in words:
            if word in ("'", '"'):
                raise ValueError("a string without an end")
            depth += (word in "([{") - (word in ")]}")
            if depth > 1 or (depth == 1 and word != ","):
                part = [*part, word][:_STORED_WORDS]
                continue
            if len(part) == _STORED_WORDS - 1 and part[1] == "=" and _LITERAL.fullmatch(part[2]):
                values[part[0]] = ast.literal_eval(part[2])
            part = []
            if depth < 1:
                return values
    raise ValueError("no end")
