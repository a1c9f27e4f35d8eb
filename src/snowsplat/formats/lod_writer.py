"""Writes levels of detail as streamed SOG; see `lod` for the format.

The scene is divided at medians into boxes with about equally many Gaussians, the leaves of a tree.
In every leaf, neighbours are merged (`simplify`) until a level has a quarter of the Gaussians of
the level before it: from twice the distance, a surface covers a quarter of the pixels. A leaf is
merged on its own, so the levels of two adjacent leaves fit together in any combination, and the
memory that is needed does not grow with the scene.

A file contains one level of a run of consecutive leaves. Consecutive leaves of the tree are
neighbours in the scene.
"""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.formats import packing
from snowsplat.formats.gaussian_arrays import GaussianArrays
from snowsplat.formats.lod import INDEX
from snowsplat.formats.sog import encode_sog
from snowsplat.util.errors import UserError
from snowsplat.util.files import new_entries, write_bytes, write_text

_FACTOR = 4  # between the numbers of Gaussians of two levels
_FARTHER = 2.3  # see `simplify`: each level is shown from about three times the distance
# Each thread needs memory for one file.
_MOST_THREADS = 4
_SAMPLE = 4096  # Gaussians from which the shape of a box is estimated
_LARGEST = 80.0  # logarithm of a scale; a larger one is not finite in the browser
_FOLDER = "levels"
_FOLDERS = re.compile(rf"{_FOLDER}(_\d+)?")
_MEMBER = re.compile(r"\d+_\d+")


@dataclass(frozen=True)
class LodSizes:
    """Numbers of Gaussians."""

    leaf: int = 1 << 15  # the most in a leaf, at level 0
    # About as many are in a file. A viewer loads a file as a whole.
    file: int = 1 << 17
    coarsest: int = 100_000  # the most in the coarsest level, which a viewer shows first

    def levels(self, count: int) -> int:
        """The number of levels of a scene with ``count`` Gaussians."""
        return 1 + math.ceil(math.log(max(1.0, count / self.coarsest), _FACTOR))


def write_lod(
    path: Path | str,
    gaussians: GaussianArrays,
    *,
    sizes: LodSizes | None = None,
    report: Callable[[int, int, str], None] = lambda done, total, what: None,
) -> None:
    """Write `lod-meta.json` and, in a folder beside it, the levels.

    The index is written last, so an interrupted call changes nothing. Earlier levels there are
    removed. The folder of the index is created if it is missing.

    ``report``: called with the number of finished files, of all files, and the word "files".

    Raises:
        UserError: ``path`` has another name.
        OSError: a file cannot be written.
    """
    path, sizes = Path(path), sizes or LodSizes()
    if path.name != INDEX:
        raise UserError(
            "{path}: viewers find levels of detail by their name; write FOLDER/{index}",
            path=path,
            index=INDEX,
        )
    packable = packing.packable(path, gaussians)
    levels = sizes.levels(len(packable.means))
    tree = _Node.around(packable.means, np.arange(len(packable.means)), sizes.leaf)
    leaves = list(tree.leaves())
    path.parent.mkdir(parents=True, exist_ok=True)
    before = _level_folders(path.parent)
    folder = _free_name(path.parent)
    with new_entries(path.parent, [folder.name]) as new:
        (new / folder.name).mkdir()
        writer = _Writer(new / folder.name, sizes.file, levels, report)
        writer.write(packable, leaves)
    counts = [sum(leaf.runs[level]["count"] for leaf in leaves) for level in range(levels)]
    index = {
        "version": 1,
        "asset": {"generator": "snowsplat"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": levels,
        "filenames": [f"{folder.name}/{name}/meta.json" for name in writer.names],
        "tree": tree.entry(),
    }
    write_text(path, json.dumps(index))
    for old in before:
        shutil.rmtree(old, ignore_errors=True)


def _level_folders(parent: Path) -> list[Path]:
    """The folders that `write_lod` has written, also those of a process that was killed then."""
    found = [each for each in parent.iterdir() if _FOLDERS.fullmatch(each.name) and each.is_dir()]
    return [each for each in found if all(_MEMBER.fullmatch(file.name) for file in each.iterdir())]


def _free_name(parent: Path) -> Path:
    number, folder = 1, parent / _FOLDER
    while folder.exists():
        number += 1
        folder = parent / f"{_FOLDER}_{number}"
    return folder


class _Node:
    """A box of the tree.

    Attributes:
        rows: of a leaf: its Gaussians.
        bound: (2, 3) lower and upper corner, of a leaf: around the ellipsoids of all levels.
        runs: of a leaf: the entries of its levels in the index.
    """

    def __init__(self, rows: np.ndarray | None, children: tuple[_Node, ...]) -> None:
        self.rows, self.children = rows, children
        self.bound = np.zeros((2, 3))
        self.runs: list[dict[str, int]] = []

    @classmethod
    def around(cls, means: np.ndarray, rows: np.ndarray, most: int) -> _Node:
        """The tree of these rows; its leaves have at most ``most`` each."""
        if len(rows) <= most:
            return cls(rows, ())
        sample = means[rows[:: -(-len(rows) // _SAMPLE)]]
        # A few Gaussians of the background are far away, and should not determine the shape.
        low, high = np.quantile(sample, [0.1, 0.9], axis=0)
        middle = len(rows) // 2
        rows = rows[np.argpartition(means[rows, (high - low).argmax()], middle)]
        halves = (np.sort(rows[:middle]), np.sort(rows[middle:]))
        return cls(None, tuple(cls.around(means, half, most) for half in halves))

    def leaves(self) -> Iterator[_Node]:
        """All leaves, depth first: neighbours follow each other."""
        if self.rows is not None:
            yield self
        for child in self.children:
            yield from child.leaves()

    def entry(self) -> dict[str, Any]:
        """The entry of the index."""
        children = [child.entry() for child in self.children]
        if children:
            corners = np.stack([child.bound for child in self.children], 1)
            self.bound[:] = corners[0].min(0), corners[1].max(0)
        low, high = ([float(f"{x:.7g}") for x in corner] for corner in self.bound)
        bound = {"bound": {"min": low, "max": high}}
        if children:
            return {**bound, "children": children}
        return {**bound, "lods": {str(level): run for level, run in enumerate(self.runs)}}


class _Writer:
    """Merges the Gaussians of leaves, and writes the files of all levels.

    Attributes:
        names: the files in the order of their numbers.
    """

    def __init__(
        self, folder: Path, most: int, levels: int, report: Callable[[int, int, str], None]
    ) -> None:
        self._folder, self._most, self._levels, self._report = folder, most, levels, report
        self.names: list[str] = []

    def write(self, scene: GaussianArrays, leaves: Sequence[_Node]) -> None:
        """Write all levels; sets ``bound`` and ``runs`` of the leaves."""
        from snowsplat.ops import get_num_threads
        from snowsplat.util.process import single_threaded

        sizes = [len(leaf.rows) for leaf in leaves if leaf.rows is not None]
        plan = [
            self._plan(level, leaves, [-(-size // _FACTOR**level) for size in sizes])
            for level in range(self._levels)
        ]
        total, done = sum(map(len, plan)), 0
        coarser: list[list[GaussianArrays]] = []
        threads = min(_MOST_THREADS, get_num_threads())
        with single_threaded(), ThreadPoolExecutor(threads) as pool:
            for merged in pool.map(partial(self._finest, scene), *zip(*plan[0], strict=True)):
                coarser += merged
                done += 1
                self._report(done, total, "files")
            for level, files in enumerate(plan[1:], 1):
                parts = {
                    id(leaf): own[level - 1] for leaf, own in zip(leaves, coarser, strict=True)
                }
                jobs = [(name, [parts[id(leaf)] for leaf in members]) for name, members in files]
                for _ in pool.map(self._store, *zip(*jobs, strict=True)):
                    done += 1
                    self._report(done, total, "files")

    def _plan(
        self, level: int, leaves: Sequence[_Node], counts: Sequence[int]
    ) -> list[tuple[str, list[_Node]]]:
        """Divide a level among files, and record where each leaf is; returns names and leaves."""
        files: list[tuple[str, list[_Node]]] = []
        size = self._most
        for leaf, count in zip(leaves, counts, strict=True):
            if size >= self._most:
                files.append((f"{level}_{len(files)}", []))
                self.names.append(files[-1][0])
                size = 0
            leaf.runs.append({"file": len(self.names) - 1, "offset": size, "count": count})
            files[-1][1].append(leaf)
            size += count
        return files

    def _finest(
        self, scene: GaussianArrays, name: str, leaves: Sequence[_Node]
    ) -> list[list[GaussianArrays]]:
        """Write a file of level 0, and merge its Gaussians: the coarser levels of its leaves."""
        levels = [self._merged(scene, leaf) for leaf in leaves]
        self._store(name, [own[0] for own in levels])
        return [own[1:] for own in levels]

    def _merged(self, scene: GaussianArrays, leaf: _Node) -> list[GaussianArrays]:
        """All levels of a leaf; also sets its ``bound``."""
        from snowsplat.scene.simplify import simplify

        assert leaf.rows is not None
        found = [scene.select(leaf.rows).to_gaussians()]
        for run in leaf.runs[1:]:
            found.append(simplify(found[-1], run["count"], farther=_FARTHER))
        levels = []
        for gaussians in found:
            arrays = GaussianArrays.from_gaussians(gaussians)
            levels.append(arrays.select(packing.spatial_order(arrays.means)))
        corners = np.concatenate([_corners(each) for each in levels], 1)
        if corners.size:
            leaf.bound[:] = corners[0].min(0), corners[1].max(0)
        return levels

    def _store(self, name: str, parts: Sequence[GaussianArrays]) -> None:
        """Write one file, a SOG scene in a folder."""
        folder = self._folder / name
        folder.mkdir()
        for member, content in encode_sog(GaussianArrays.cat(parts)).items():
            write_bytes(folder / member, content)


def _corners(gaussians: GaussianArrays) -> np.ndarray:
    """(2, N, 3) the boxes around the ellipsoids of one standard deviation."""
    import torch  # not for the import of this module: it takes time

    from snowsplat.scene.geometry import rotation_from_quat

    rotation = rotation_from_quat(torch.from_numpy(gaussians.quats.astype(np.float64))).numpy()
    scales = np.exp(np.minimum(gaussians.log_scales, _LARGEST).astype(np.float64))
    reach = np.sqrt(np.square(rotation * scales[:, None]).sum(2))  # rotation[:, i, j]: i of axis j
    return np.stack([gaussians.means - reach, gaussians.means + reach])
