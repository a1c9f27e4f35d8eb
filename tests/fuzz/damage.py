"""Damaging the bytes of a file by random changes."""

import copy
import json
import random
import struct
from typing import Any

#: Values for counts and sizes: zero, few, the limits of integer types, more than the file has.
WORDS = [0, 1, 2, 3, 255, 256, 2**15, 2**16 - 1, 2**16, 2**24, 10**7, 2**31 - 1, 2**31, 2**32 - 1]
WORDS += [2**32, 2**40, 2**63 - 1, 2**63, 2**64 - 1, 0x7F800000, 0x7FC00000]
#: Strings that are likely to break readers of text and JSON.
TEXTS = [b"-1", b"1e400", b"nan", b"9" * 30, b"../../../x", b"/etc/passwd", b"\0", b"\xff", b"\n"]
TEXTS += [b"[" * 3000, b"{}", b"null", b'"', b"'", b"true", b" ", b"#", b"\xf0\x9f\x98\x80"]
#: Values in place of others in JSON.
ODD = [None, True, -1, 0, 1, 7, 2**31, 10**18, 1e308, -0.5, "", "a", "meta.json", [], {}, [0], [[]]]
ODD += [float("nan"), float("inf"), {"a": 1}, [0.0] * 300]
KINDS = ["bit", "byte", "word", "big", "long", "text", "cut", "drop", "double", "swap", "fill"]

#: Kind, whether near the start of the file, position (0 to 1), two parameters (0 to 255).
Change = tuple[str, bool, float, int, int]


def random_change(generator: random.Random) -> Change:
    """A random change."""
    head, where = generator.random() < 0.5, generator.random()
    numbers = generator.randrange(256), generator.randrange(256)
    return generator.choice(KINDS), head, where, *numbers


def damaged(data: bytes, changes: list[Change]) -> bytes:
    """The bytes after all changes, applied in order."""
    for change in changes:
        data = _changed(data, *change)
    return data


def _changed(data: bytes, kind: str, head: bool, where: float, a: int, b: int) -> bytes:
    at = int(where * (min(len(data), 200) if head else len(data)))
    before, after = data[:at], data[at:]
    word = WORDS[a % len(WORDS)]
    if kind == "bit":
        return before + bytes(byte ^ 1 << a % 8 for byte in after[:1]) + after[1:]
    if kind == "byte":
        return before + bytes([a]) + after[1:]
    if kind == "word":
        return before + struct.pack("<I", word & 0xFFFFFFFF) + after[4:]
    if kind == "big":
        return before + struct.pack(">I", word & 0xFFFFFFFF) + after[4:]
    if kind == "long":
        return before + struct.pack("<Q", word) + after[8:]
    if kind == "text":
        return before + TEXTS[a % len(TEXTS)] + after[b % 8 :]
    if kind == "cut":
        return before
    if kind == "drop":
        return before + after[1 + a :]
    if kind == "double":
        return before + after[: 1 + a] * (2 + b) + after[1 + a :]
    if kind == "swap":
        size = 1 + a
        return before + after[size : 2 * size] + after[:size] + after[2 * size :]
    return before + bytes([b]) * len(after[: 1 + a]) + after[1 + a :]


def damaged_json(data: bytes, changes: list[Change]) -> bytes:
    """The bytes parsed as JSON, with values replaced by unexpected ones or removed."""
    try:
        document: Any = json.loads(data)
    except (ValueError, RecursionError):
        return data
    if not isinstance(document, dict):
        document = {"whole": document}
    for _, _, where, a, _ in changes:
        places = _places(document)
        if not places:
            break
        container, key = places[int(where * 0.999 * len(places))]
        if a < 30:
            del container[key]
        else:
            container[key] = copy.deepcopy(ODD[a % len(ODD)])
    return json.dumps(document.get("whole", document)).encode()


def _places(value: Any) -> list[tuple[Any, Any]]:
    """Container and key of every element of ``value``; of lists, only the first four elements."""
    found: list[tuple[Any, Any]] = []
    keys: list[Any] = []
    if isinstance(value, dict):
        keys = list(value)
    elif isinstance(value, list):
        keys = list(range(min(len(value), 4)))
    for key in keys:
        found += [(value, key), *_places(value[key])]
    return found
