"""What anybody may have written: JSON that takes little memory, names that stay at home."""

from __future__ import annotations

import json
import os
import sys
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

_Kind = TypeVar("_Kind")

# What values take in memory, by the character that comes with each: generous figures of CPython.
_BYTES_OF = {b"{": 240, b"[": 72, b",": 48, b":": 48, b'"': 28}
_ALWAYS_ALLOWED = 48 << 20  # bytes of memory
_RATIO = (
    2  # bytes of memory for each of a larger file; those that programs write need about as much
)
_LARGEST_HEADER = 1 << 20  # bytes
_DEEPEST = 100  # values within each other; what goes through them calls itself
_WHOLE = 1 << 64  # whole numbers are smaller; of any size, they overflow what is reckoned with them


def read_json(path: Path) -> Any:
    """The value in a JSON file.

    Raises:
        OSError: absent, or not to be read.
        ValueError: see `parse_json`; or it is no file at all, but a pipe or a device.
    """
    if path.exists() and not path.is_file():  # a pipe never ends
        raise ValueError("not a file")
    return parse_json(path.read_bytes())


def parse_json(data: bytes) -> Any:
    """The value of a JSON text in UTF-8, with or without a mark of that.

    ``[[],[],[]`` takes twenty times as much memory as text: what would take too much is refused
    before any is taken.

    Raises:
        ValueError: not JSON, nested too deep, or of absurdly many values. No other error.
    """
    needed = sum(data.count(sign) * size for sign, size in _BYTES_OF.items())
    if needed > _ALWAYS_ALLOWED + _RATIO * len(data):
        raise ValueError("absurdly many values")
    try:
        value = json.loads(data.decode("utf-8-sig"))
    except RecursionError:
        raise ValueError("nested too deep") from None
    level = [value] if isinstance(value, dict | list) else []
    for _ in range(_DEEPEST):
        inner = (each.values() if isinstance(each, dict) else each for each in level)
        level = [value for values in inner for value in values if isinstance(value, dict | list)]
        if not level:
            return value
    raise ValueError("nested too deep")


def check_header(path: Path) -> None:
    """Whether a safetensors file may be opened: each tensor takes ten times its part of the header.

    Raises:
        OSError: absent, or not to be read.
        ValueError: a header that is absurdly large, or no file at all.
    """
    if path.exists() and not path.is_file():
        raise ValueError("not a file")
    with open(path, "rb") as file:
        size = int.from_bytes(file.read(8), "little")
    if size > _LARGEST_HEADER:
        raise ValueError("absurdly many tensors")


def is_file(path: Path) -> bool:
    """Whether a file is there, not a pipe nor a device; a name may be no name at all."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def inside(folder: Path, name: str) -> Path | None:
    """``folder / name``; None where a name that a file gives leads out of the folder, or is none.

    That is by names alone: a link that lies in the folder was put there by whoever keeps it.
    """
    if "\0" in name:
        return None
    home = os.path.abspath(folder)
    there = os.path.abspath(os.path.join(home, name))
    return folder / name if Path(there).is_relative_to(home) else None


def printable(text: str) -> str:
    """A text for pages and terminals.

    Names may hold bytes that are no text, and control characters: XML refuses these, and terminals
    obey them.
    """
    text = text.encode("utf-8", "replace").decode("utf-8")
    return "".join(c if c in "\n\t" or c.isprintable() else "\ufffd" for c in text)


def quoted(value: object) -> str:
    """What a file says there, for a message of one line: its beginning, in quotes."""
    return repr(printable(str(value))[:80])


def from_json(kind: type[_Kind], values: Any) -> _Kind:
    """A dataclass from JSON values, which have to be what its fields are declared as.

    A list is a tuple where one is meant, a whole number passes for any; fields may be left out if
    they have a default.

    Raises:
        ValueError: of other types, of other fields, or not finite.
    """
    if not isinstance(values, dict):
        raise ValueError(f"no {kind.__name__}")
    hints = get_type_hints(kind)
    known = {field.name for field in fields(kind) if field.init}  # type: ignore[arg-type]
    if not values.keys() <= known:
        raise ValueError(f"no {kind.__name__}: {quoted(sorted(values.keys() - known)[0])}")
    try:
        return kind(**{name: _as(hints[name], value) for name, value in values.items()})
    except TypeError as error:  # one is missing
        raise ValueError(str(error)) from None


def _as(hint: Any, value: Any) -> Any:
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        for part in parts:
            with suppress(ValueError):
                return _as(part, value)
    elif origin is Literal:
        if isinstance(value, str) and value in parts:
            return value
    elif origin in (tuple, list) and isinstance(value, list | tuple):
        every = origin is list or parts[-1] is Ellipsis
        kinds = [parts[0]] * len(value) if every else parts
        if len(kinds) == len(value):
            return origin(_as(part, item) for part, item in zip(kinds, value, strict=True))
    elif origin is dict and isinstance(value, dict):
        return {_as(parts[0], key): _as(parts[1], item) for key, item in value.items()}
    elif hint is Any:
        return value
    elif hint is float:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if number and abs(value) <= sys.float_info.max:
            return value
    elif hint is int:
        if type(value) is int and abs(value) < _WHOLE:
            return value
    elif isinstance(hint, type) and is_dataclass(hint):
        return from_json(hint, value)
    elif isinstance(hint, type) and type(value) is hint:
        return value
    raise ValueError(f"{quoted(value)} is no {getattr(hint, '__name__', hint)}")
