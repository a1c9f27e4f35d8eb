"""The names of files in ``input/``: unique, and not too long."""

from __future__ import annotations

from pathlib import PurePosixPath

from snowsplat.util.files import shown

_LONGEST_NAME = 200  # bytes of a name in input/
_KEPT_END = 12  # characters at the end of a longer name


def folded_stem(name: str) -> str:
    """The name of a file without its suffix, and without a difference of case."""
    return str(PurePosixPath(name).with_suffix("")).casefold()


def _shorten(part: str) -> str:
    """A name of at most 200 bytes, so that ".NAME.png.tmp" fits into the 255 of a file system."""
    if len(part.encode()) <= _LONGEST_NAME:
        return part
    path = PurePosixPath(part)
    end = path.stem[-_KEPT_END:] + path.suffix  # with the number of the photo
    room = max(0, _LONGEST_NAME - len(end.encode()))
    return path.stem.encode()[:room].decode(errors="ignore") + end


def free_name(name: str, taken: set[str]) -> str:
    """``name``, or a variant of it that is not in ``taken`` except for case, and not too long.

    "a.jpg" becomes "a_2.jpg", "a_3.jpg" and so on. The result is added to ``taken``.
    """
    name = "/".join(_shorten(part) for part in shown(name).split("/"))
    path = PurePosixPath(name)
    candidate, n = name, 1
    while candidate.casefold() in taken:
        n += 1
        candidate = str(path.with_name(f"{path.stem}_{n}{path.suffix}"))
    taken.add(candidate.casefold())
    return candidate
