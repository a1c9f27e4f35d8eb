"""Finds the file that a dataset means by a name, if the file is not where the name says.

Datasets move between computers and programs: the case or the kind of the suffix changes, paths are
those of another computer, folders are added or removed, and names change their encoding. A file is
taken only if there is no doubt.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import PurePosixPath

from snowsplat.data.files.listing import PHOTO_FOLDERS, fold_name

# The encodings of file names on computers whose names are not Unicode, and the Western ones that
# programs take for granted if they do not know better.
_ENCODINGS = ("gbk", "shift_jis", "big5", "euc_kr", "cp1252", "cp1251", "latin-1")
_MISTAKEN = ("cp437", "cp1252", "latin-1", "gbk", "shift_jis")
# Parts of a path that are compared, from its end.
_MOST_PARTS = 16
# Files with one name in different folders. Among more, none is certain.
_MOST_ALIKE = 100


@dataclass(frozen=True)
class Matches:
    """The files that names mean.

    Attributes:
        files: name -> file, for the names whose file is certain.
        doubtful: names for which there are several files, or one file for several names.
    """

    files: dict[str, str]
    doubtful: list[str]


def match_names(
    names: Sequence[str], files: Iterable[str], *, other_folders: bool = True
) -> Matches:
    """The file that each name means. No file belongs to two names.

    A name may differ from its file in these ways, and the first way that finds a file counts: the
    case of letters and the form or encoding of Unicode; the suffix; then, with the same differences
    or without, the folders before it. The folders of a name and of its file must agree as far as
    both have them; only folders that are called "images" or the like may be called otherwise. If
    names without their folders could be mixed up, none of them is found without its folders.

    Args:
        names: relative or absolute paths, as a dataset states them, on any system. Different.
        files: relative paths with "/", of images only.
        other_folders: whether the folders of a name and its file may differ.
    """
    found: dict[str, str] = {}
    left, free = list(names), list(dict.fromkeys(files))
    doubtful: set[str] = set()
    for with_suffix in (True, False):
        certain, _ = _unique(_same_path(left, free, with_suffix))
        found |= certain
        left, free = _rest(left, free, certain)
    for with_suffix in (True, False) if other_folders else ():
        for renamed in (False, True):
            certain, unsure = _unique(_same_end(left, free, with_suffix, renamed))
            if unsure:  # other names may be mixed up too, without a sign of it
                doubtful |= unsure
                continue
            found |= certain
            left, free = _rest(left, free, certain)
    return Matches(found, [name for name in left if name in doubtful])


def _rest(left: list[str], free: list[str], certain: dict[str, str]) -> tuple[list[str], list[str]]:
    taken = set(certain.values())
    return [n for n in left if n not in certain], [f for f in free if f not in taken]


def _unique(candidates: dict[str, set[str]]) -> tuple[dict[str, str], set[str]]:
    """The names with one file that belongs to no other name; and the names with files in doubt."""
    claims: dict[str, int] = {}
    for files in candidates.values():
        for file in files:
            claims[file] = claims.get(file, 0) + 1
    certain = {
        name: next(iter(files))
        for name, files in candidates.items()
        if len(files) == 1 and claims[next(iter(files))] == 1
    }
    return certain, candidates.keys() - certain.keys()


def _same_path(names: list[str], files: list[str], with_suffix: bool) -> dict[str, set[str]]:
    by_key: dict[tuple[str, ...], set[str]] = {}
    for file in files:
        for key in _keys(file, with_suffix):
            by_key.setdefault(key, set()).add(file)
    found = {}
    for name in names:
        hits = set().union(*(by_key.get(key, set()) for key in _keys(name, with_suffix)))
        if hits:
            found[name] = hits
    return found


def _same_end(
    names: list[str], files: list[str], with_suffix: bool, renamed: bool
) -> dict[str, set[str]]:
    """The files that share most of the end of their path with a name.

    ``renamed``: a folder that says nothing may differ; otherwise, one path is the end of the other.
    """
    whole: dict[tuple[str, ...], list[tuple[tuple[str, ...], str]]] = {}
    ends: dict[tuple[str, ...], list[tuple[tuple[str, ...], str]]] = {}
    for file in files:
        for key in _keys(file, with_suffix):
            whole.setdefault(key, []).append((key, file))
            for length in range(1, len(key) + 1):
                ends.setdefault(key[-length:], []).append((key, file))
    found: dict[str, set[str]] = {}
    for name in names:
        best = 0
        for key in _keys(name, with_suffix):
            for length in range(len(key), max(best, 1) - 1, -1):
                end = key[-length:]
                if renamed and length < len(key):
                    alike = [
                        file
                        for other, file in ends.get(end, [])[:_MOST_ALIKE]
                        if len(other) == length
                        or PHOTO_FOLDERS & {key[-length - 1], other[-length - 1]}
                    ]
                else:
                    among = ends if length == len(key) else whole
                    alike = [file for _, file in among.get(end, [])]
                if alike:
                    hits = found.setdefault(name, set())
                    if length > best:
                        hits.clear()
                    hits.update(alike)
                    best = length
                    break
    return found


def _keys(path: str, with_suffix: bool) -> Iterator[tuple[str, ...]]:
    """The parts of a path as they are compared, in each encoding that the name may have."""
    for text in _readings(path):
        parts = [
            part
            for part in text.replace("\\", "/").split("/")
            if part not in ("", ".", "..") and not part.endswith(":")
        ]
        if parts and not with_suffix:
            parts[-1] = PurePosixPath(parts[-1]).stem
        if parts:
            yield tuple(fold_name(part) for part in parts[-_MOST_PARTS:])


def _readings(text: str) -> list[str]:
    """A name, and what it is in other encodings if its characters are not plain ASCII."""
    if text.isascii():
        return [text]
    readings = [text]
    try:
        raw = text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:  # half a character, of a damaged file
        return [text]
    try:
        raw.decode("utf-8")
    except UnicodeDecodeError:  # bytes of another encoding
        for encoding in _ENCODINGS:
            with suppress(UnicodeDecodeError):
                readings.append(raw.decode(encoding))
    else:  # perhaps UTF-8 that was taken for another encoding
        for encoding in _MISTAKEN:
            with suppress(UnicodeError):
                readings.append(text.encode(encoding).decode("utf-8"))
    return list(dict.fromkeys(readings))
