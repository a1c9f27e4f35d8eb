"""Reading untrusted JSON and file names: limited memory, no paths outside a folder."""

import functools
import json
import os
import sys
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from snowsplat.util.errors import Problem
from snowsplat.util.messages import Message, as_message

_Kind = TypeVar("_Kind")

# Upper bounds of the memory of JSON values in CPython: bytes per occurrence of each character.
_BYTES_OF = {b"{": 240, b"[": 72, b",": 48, b":": 48, b'"': 28}
# Memory that is always allowed for JSON values, in bytes.
_ALWAYS_ALLOWED = 48 << 20
# Additional memory per byte of the text. JSON files that programs write need about this much.
_RATIO = 2
# Largest header of a safetensors file in bytes.
_MAX_HEADER = 1 << 20
# Largest nesting depth. Code that walks through values is recursive.
_MAX_DEPTH = 100
# Limit of integers. Larger ones would overflow in computations.
_MAX_INTEGER = 1 << 64
# Longest name of a file or folder, in characters: no usual file system has longer ones.
_LONGEST_NAME = 255


def read_json(path: Path, ratio: int = _RATIO) -> Any:
    """The value in a JSON file.

    ``ratio``: see `parse_json`.

    Raises:
        OSError: the file is missing or cannot be read.
        ValueError: see `parse_json`; or ``path`` is a pipe or a device.
    """
    if path.exists() and not path.is_file():  # reading a pipe may never end
        raise Problem("not a file")
    return parse_json(path.read_bytes(), ratio)


def encoding_of(data: bytes) -> str:
    """The encoding of a text that begins with these bytes: UTF-8, with or without a byte order
    mark, or UTF-16 with one. Programs on Windows write such marks."""
    return "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"


def lenient(encoding: str) -> tuple[str, str]:
    """Encoding and handling of errors, for names of files: bytes that are not UTF-8 stay as they
    are. UTF-16 has no such bytes."""
    return encoding, "replace" if encoding == "utf-16" else "surrogateescape"


def parse_json(data: bytes, ratio: int = _RATIO) -> Any:
    """The value of a JSON text; see `encoding_of`.

    Some texts, such as ``[[],[],[]``, need twenty times their size in memory. A text that would
    need too much is rejected before it is parsed.

    ``ratio``: memory that is allowed per byte of the text, in addition to a fixed amount.

    Raises: ValueError: not JSON, nested too deeply, or too many values. No other error is raised.
    """
    needed = sum(data.count(sign) * size for sign, size in _BYTES_OF.items())
    if needed > _ALWAYS_ALLOWED + ratio * len(data):
        raise Problem("too many values")
    try:
        value = json.loads(data.decode(encoding_of(data)))
    except RecursionError:
        raise Problem("nested too deeply") from None
    level = [value] if isinstance(value, dict | list) else []
    for _ in range(_MAX_DEPTH):
        inner = (each.values() if isinstance(each, dict) else each for each in level)
        level = [value for values in inner for value in values if isinstance(value, dict | list)]
        if not level:
            return value
    raise Problem("nested too deeply")


def check_header(path: Path) -> None:
    """Check the header size of a safetensors file before the file is opened with its library.

    In memory a tensor needs ten times the size of its entry in the header.

    Raises:
        OSError: the file is missing or cannot be read.
        ValueError: the header is too large, or ``path`` is a pipe or a device.
    """
    if path.exists() and not path.is_file():
        raise Problem("not a file")
    with open(path, "rb") as file:
        size = int.from_bytes(file.read(8), "little")
    if size > _MAX_HEADER:
        raise Problem("too many tensors")


def is_file(path: Path) -> bool:
    """Whether ``path`` is a regular file. Invalid names, for example with a NUL, return False."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def inside(folder: Path, name: str) -> Path | None:
    """``folder / name``; None if that is outside ``folder`` or ``name`` is not a valid name.

    Only names are compared. Symbolic links in the folder are followed, because only the owner of
    the folder can create them.
    """
    if "\0" in name or max(map(len, name.split("/"))) > _LONGEST_NAME:
        return None
    root = os.path.abspath(folder)
    target = os.path.abspath(os.path.join(root, name))
    return folder / name if Path(target).is_relative_to(root) else None


def printable(text: str) -> str:
    """A text that is safe for HTML pages and terminals.

    File names may contain invalid bytes and control characters. Control characters are invalid in
    XML, and terminals interpret them. They are replaced by U+FFFD, and invalid bytes by "?".
    """
    text = text.encode("utf-8", "replace").decode("utf-8")
    return "".join(c if c in "\n\t" or c.isprintable() else "\ufffd" for c in text)


def quoted(value: object) -> str:
    """The first 80 characters of an untrusted value, in quotes, for a one-line message."""
    return repr(printable(str(value))[:80])


def from_json(kind: type[_Kind], values: Any) -> _Kind:
    """A dataclass from JSON values. The values must have the declared types of the fields.

    Lists are accepted for tuples, and integers for floats. Fields with a default may be missing.
    A `Message` is read as it is written by `dataclasses.asdict`.

    Raises:
        ValueError: a value has another type or is not finite, or a field is unknown or missing.
    """
    if not isinstance(values, dict):
        raise Problem("not a {kind}", kind=kind.__name__)
    hints = _hints(kind)  # type: ignore[arg-type]
    known = {field.name for field in fields(kind) if field.init}  # type: ignore[arg-type]
    if not values.keys() <= known:
        unknown = quoted(sorted(values.keys() - known)[0])
        raise Problem("unknown field of {kind}: {name}", kind=kind.__name__, name=unknown)
    try:
        return kind(**{name: _as(hints[name], value) for name, value in values.items()})
    except TypeError as error:  # a field is missing
        raise Problem(as_message(error)) from None


# To find the types of the fields takes longer than the rest of `from_json`.
_hints = functools.cache(get_type_hints)


def _as(hint: Any, value: Any) -> Any:
    """``value`` converted to the type ``hint``; raises `ValueError` if the types do not match."""
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
        if type(value) is int and abs(value) < _MAX_INTEGER:
            return value
    elif hint is Message:
        return Message.from_json(value)
    elif isinstance(hint, type) and is_dataclass(hint):
        return from_json(hint, value)
    elif isinstance(hint, type) and type(value) is hint:
        return value
    kind = getattr(hint, "__name__", hint)
    raise Problem("{value} is not of type {kind}", value=quoted(value), kind=kind)
