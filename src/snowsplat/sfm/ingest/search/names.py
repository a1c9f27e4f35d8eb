"""The names of files in ``input/``: unique, and not too long."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import PurePosixPath

from snowsplat.util.files import shown

_LONGEST_NAME = 200  # bytes of a name in input/
_KEPT_END = 12  # characters at the end of a longer name


def free_names(names: Sequence[str]) -> Iterator[str]:
    """The names, made unique and not too long: a name that equals an earlier one except for case
    gets a suffix.

    "a.jpg" becomes "a_2.jpg", "a_3.jpg" and so on.
    """
    taken: set[str] = set()
    for name in names:
        yield free_name(name, taken)


def _shortened(part: str) -> str:
    """A name of at most 200 bytes, so that ".NAME.png.tmp" fits into the 255 of a file system."""
    if len(part.encode()) <= _LONGEST_NAME:
        return part
    path = PurePosixPath(part)
    end = path.stem[-_KEPT_END:] + path.suffix  # with the number of the photo
    room = max(0, _LONGEST_NAME - len(end.encode()))
    return path.stem.encode()[:room].decode(errors="ignore") + end


def free_name(name: str, taken: set[str]) -> str:
    """``name``, or a variant of it that is not in ``taken``; the result is added to ``taken``."""
    name = "/".join(_shortened(part) for part in shown(name).split("/"))
    path = PurePosixPath(name)
    candidate, n = name, 1
    while candidate.casefold() in taken:
        n += 1
        candidate = str(path.with_name(f"{path.stem}_{n}{path.suffix}"))
    taken.add(candidate.casefold())
    return candidate
