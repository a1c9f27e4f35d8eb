"""Streamed SOG: a scene in levels of detail, from which a viewer loads only what it shows.

The scene is a folder. The file `lod-meta.json` in it has a tree of boxes. Each leaf of the tree
stores the Gaussians in its box several times, once per level: level 0 is the scene itself, and
every further level has fewer Gaussians. A level of a leaf is a run of rows in one of the other
files, which are SOG scenes (the `meta.json` of a folder each). A viewer shows one level of each
leaf, a finer one where the camera is near.

    {"version": 1, "count": …, "counts": [per level], "lodLevels": …,
     "environment": "env/meta.json" (optional; Gaussians that are always shown),
     "filenames": ["0_0/meta.json", …],
     "tree": {"bound": {"min": [x, y, z], "max": [x, y, z]}, "children": [node, …]}}

A leaf has "lods" instead of "children": {"0": {"file": …, "offset": …, "count": …}, …}. Numbers of
files are indices into "filenames". The coordinate frame is that of the PLY files. Specification:
developer.playcanvas.com, "The Streamed SOG Format". `lod_writer` writes these folders.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.formats.damage import Damaged, Unsupported, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, without_unusable
from snowsplat.formats.sog import read_stored, sog_files
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import inside, quoted, read_json

#: The name of the index. Viewers recognise the format by it.
INDEX = "lod-meta.json"
#: The name of the format, for users.
LEVELS = "streamed SOG"
#: Most levels of an index. Each of them usually has half of the Gaussians of the finer one.
_MOST_LEVELS = 1000
#: Longest path in an index. Programs write such as "0_0/meta.json".
_LONGEST_NAME = 200


@dataclass(frozen=True)
class Run:
    """``count`` Gaussians from row ``offset`` of a file."""

    file: int
    offset: int
    count: int


@dataclass(frozen=True)
class LodIndex:
    """The content of `lod-meta.json`."""

    levels: int  # the number of levels, at least 1
    # The SOG scenes. All of them are inside of the folder.
    files: list[Path]
    # For each leaf, its runs by level; runs without Gaussians are left out.
    leaves: list[dict[int, Run]]
    environment: Path | None  # the SOG scene that is always shown, if there is one

    def counts(self) -> list[int]:
        """The number of Gaussians of each level."""
        return [
            sum(leaf[level].count for leaf in self.leaves if level in leaf)
            for level in range(self.levels)
        ]


def is_lod(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is the index of levels of detail."""
    return head.lstrip().startswith(b"{") and b'"lodLevels"' in head


@reads
def read_lod(path: Path, level: int = 0) -> GaussianArrays:
    """Read one level of `lod-meta.json`; level 0 is the complete scene.

    ``level``: leaves without this level are read at the next coarser level that they have, and if
    there is none, at the next finer one.

    Raises: UserError: a file is missing or damaged.
    """
    index = read_index(path)
    order = [*range(level, index.levels), *reversed(range(min(level, index.levels)))]
    runs: dict[int, list[Run]] = {}
    for leaf in index.leaves:
        chosen = next((leaf[each] for each in order if each in leaf), None)
        if chosen is not None:
            runs.setdefault(chosen.file, []).append(chosen)
    parts = [_rows(index.files[file], runs[file]) for file in sorted(runs)]
    if index.environment is not None:
        parts.append(read_stored(index.environment))
    return without_unusable(path, GaussianArrays.cat(parts))


@reads
def read_index(path: Path) -> LodIndex:
    """The content of `lod-meta.json`.

    Raises: UserError: it cannot be read, is damaged, or names a file outside of its folder.
    """
    try:
        meta = read_json(path)
    except ValueError as error:
        raise Damaged("{error}", error=error) from None
    try:
        if meta.get("version", 1) != 1:  # the first files had no version
            raise Unsupported("version {meta}; supported is 1", meta=quoted(meta["version"]))
        levels, names = meta["lodLevels"], meta["filenames"]
        environment = meta.get("environment")
        leaves = list(_leaves(meta["tree"], _number(levels, 1, _MOST_LEVELS), len(names)))
        files = [_file(path, name) for name in names]
        always = None if environment is None else _file(path, environment)
    except (AttributeError, KeyError, TypeError, ValueError):
        raise Damaged("does not describe levels of detail") from None
    return LodIndex(levels, files, leaves, always)


def lod_files(path: Path) -> list[Path]:
    """The index and all files that it needs, directly or through the SOG scenes.

    Raises: UserError: a file is damaged.
    """
    index = read_index(path)
    scenes = [*index.files, *([index.environment] if index.environment else [])]
    return [path, *(file for scene in scenes for file in sog_files(scene))]


def lod_bytes(path: Path) -> int:
    """The size of `lod_files` together."""
    return sum(file.stat().st_size for file in lod_files(path))


def _leaves(tree: Any, levels: int, files: int) -> Iterator[dict[int, Run]]:
    nodes = [tree]
    while nodes:
        node = nodes.pop()
        if "lods" not in node:
            nodes += reversed(node["children"])
            continue
        runs = {}
        for name, entry in node["lods"].items():
            level = _number(int(name), 0, levels - 1)
            count = _number(entry.get("count", 0), 0)
            if count:
                file = _number(entry["file"], 0, files - 1)
                runs[level] = Run(file, _number(entry.get("offset", 0), 0), count)
        yield runs


def _number(value: Any, low: int, high: int = 1 << 40) -> int:
    if type(value) is not int or not low <= value <= high:
        raise ValueError
    return value


def _file(path: Path, name: Any) -> Path:
    found = None
    if isinstance(name, str):
        if len(name) > _LONGEST_NAME:
            raise ValueError
        found = inside(path.parent, name)
    if found is None:
        raise Unsupported("refers to a file outside of its folder ({name})", name=quoted(name))
    return found


def _rows(path: Path, runs: list[Run]) -> GaussianArrays:
    """The rows of a SOG scene that belong to the runs."""
    scene = read_stored(path)
    if any(run.offset + run.count > len(scene.means) for run in runs):
        raise UserError(
            "{path}: has too few Gaussians for its {index}; copy or export it again",
            path=path,
            index=INDEX,
        )
    if sum(run.count for run in runs) > len(scene.means):
        raise UserError(
            "{path}: used twice by its {index}; copy or export it again", path=path, index=INDEX
        )
    rows = [np.arange(run.offset, run.offset + run.count) for run in runs]
    return scene.select(np.concatenate(rows))
