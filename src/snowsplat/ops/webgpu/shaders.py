"""What a file in `native/wgsl` declares, read from its text.

The variables of a file are named as the fields in `native/params.h`, with "_" in place of ".".
Numbers are in ``struct Params``; besides fields, it may have for a tensor x ``has_x`` (whether x is
not null) and ``x_offset`` (the index of its first element in the binding, in words of 4 bytes).
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[2] / "native" / "wgsl"

_VARIABLE = re.compile(r"@group\(0\)\s*@binding\((\d+)\)\s*var<(uniform|storage[^>]*)>\s*(\w+)\s*:")
_PARAMS = re.compile(r"struct Params\s*\{(.*?)\}", re.DOTALL)
_FUNCTION = re.compile(r"((?:@compute\s*@workgroup_size\([^)]*\)\s*)?)fn\s+(\w+)\s*\(")


@dataclass(frozen=True)
class Binding:
    """A tensor of a kernel: its number, and whether the kernel writes to it."""

    index: int
    written: bool


@dataclass(frozen=True)
class Shader:
    """A file.

    Attributes:
        text: its content.
        bindings: the tensors of the file, by name.
        uniform: the number of the binding of the numbers; None: there are none.
        numbers: name and type ("f32", "i32" or "u32") of the numbers, in order.
        entries: for each kernel, the names of the tensors that it uses, and whether it uses the
            numbers.
    """

    text: str
    bindings: dict[str, Binding]
    uniform: int | None
    numbers: tuple[tuple[str, str], ...]
    entries: dict[str, tuple[tuple[str, ...], bool]]


@functools.cache
def shader(file: str) -> Shader:
    """The content of ``native/wgsl/<file>.wgsl``."""
    return read((FOLDER / f"{file}.wgsl").read_text(encoding="utf-8"))


def read(text: str) -> Shader:
    """What a text in WGSL declares."""
    code = re.sub(r"//[^\n]*", "", text)
    bindings, uniform, uniform_name = {}, None, ""
    for index, kind, name in _VARIABLE.findall(code):
        if kind == "uniform":
            uniform, uniform_name = int(index), name
        else:
            bindings[name] = Binding(int(index), "read_write" in kind)
    fields = _PARAMS.search(code)
    numbers = tuple(re.findall(r"(\w+)\s*:\s*(\w+)", fields[1])) if fields else ()
    starts = list(_FUNCTION.finditer(code))
    ends = [each.start() for each in starts[1:]] + [len(code)]
    words = {
        start[2]: set(re.findall(r"\w+", code[start.end() : end]))
        for start, end in zip(starts, ends, strict=True)
    }
    entries = {}
    for start in starts:
        if start[1]:
            used = _reached(start[2], words)
            entries[start[2]] = tuple(x for x in bindings if x in used), uniform_name in used
    return Shader(text, bindings, uniform, numbers, entries)


def _reached(function: str, words: dict[str, set[str]]) -> set[str]:
    """All words of a function and of those that it calls."""
    found: set[str] = set()
    todo = [function]
    while todo:
        for word in words[todo.pop()] - found:
            found.add(word)
            if word in words:
                todo.append(word)
    return found
