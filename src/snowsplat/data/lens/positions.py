"""Positions in a photo of all pixels of an image, interpolated between few nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

_LARGEST_ERROR = 0.01  # pixels, of the interpolation between nodes
_CELLS = (64, 32, 16, 8, 4, 2)  # pixels: approximate cell sizes, tried in this order
_FEWEST = 4  # cells in each direction: the errors of a few cells may vanish by symmetry
_STRIP_PIXELS = 1 << 18  # processed at a time: limits the memory and fits the caches


@dataclass(frozen=True, eq=False)
class Positions:
    """Positions x, y of the pixels (H, W) of an image, in pixels of a photo.

    The image is divided into cells with nodes at their corners. Positions within a cell are
    interpolated bilinearly.

    Attributes:
        nodes: (n, m, 2) float32; NaN where there is no position.
        column, across: (W,) int32 and float32: the node to the left of each pixel, at most m − 2,
            and the position between this node and the next one, 0..1.
        row, down: (H,) the same for the rows.
    """

    nodes: np.ndarray
    column: np.ndarray
    across: np.ndarray
    row: np.ndarray
    down: np.ndarray

    @classmethod
    def between(cls, nodes: np.ndarray, width: int, height: int) -> Positions:
        """Those of the pixels of an image of the given size, whose corners are corner nodes."""
        column, across = _cells(width, nodes.shape[1] - 1)
        return cls(nodes, column, across, *_cells(height, nodes.shape[0] - 1))

    @classmethod
    def exact(cls, positions: np.ndarray) -> Positions:
        """Those of an array (H, W, 2)."""
        nodes = np.pad(positions, ((0, 1), (0, 1), (0, 0)), mode="edge")
        height, width = positions.shape[:2]
        column, row = (np.arange(size, dtype=np.int32) for size in (width, height))
        return cls(nodes, column, np.zeros(width, np.float32), row, np.zeros(height, np.float32))

    def at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """(..., 2): the positions of the pixels in columns ``x`` and rows ``y``, broadcast."""
        column, row = self.column[x], self.row[y]
        across, down = self.across[x][..., None], self.down[y][..., None]
        upper, lower = (
            self.nodes[r, column] * (1 - across) + self.nodes[r, column + 1] * across
            for r in (row, row + 1)
        )
        return upper * (1 - down) + lower * down

    def strips(self) -> Iterator[tuple[slice, np.ndarray]]:
        """Rows of the image and their positions (H, W, 2)."""
        step = max(1, _STRIP_PIXELS // len(self.column))
        x, y = np.arange(len(self.column)), np.arange(len(self.row))
        for first in range(0, len(y), step):
            rows = slice(first, min(first + step, len(y)))
            yield rows, self.at(x, y[rows, None])


def node_grid(
    width: int, height: int, positions: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> np.ndarray:
    """`Positions.nodes`, with the largest cells for which the error is below 0.01 pixels, or else
    with the smallest ones.

    Args:
        width, height: of the image in pixels.
        positions: of columns x and rows y, in pixels, to positions (len(y), len(x), 2) in the
            photo; NaN where there are none.
    """
    for cell in _CELLS:
        x, y = (np.linspace(0, n, max(_FEWEST, -(-n // cell)) + 1) for n in (width, height))
        nodes = positions(x, y)
        # Between two nodes, in both directions: within a cell, the two errors may cancel out.
        across = positions((x[1:] + x[:-1]) / 2, y) - (nodes[:, 1:] + nodes[:, :-1]) / 2
        down = positions(x, (y[1:] + y[:-1]) / 2) - (nodes[1:] + nodes[:-1]) / 2
        if not any((np.abs(error) > _LARGEST_ERROR / 2).any() for error in (across, down)):
            break
    return nodes.astype(np.float32)


def _cells(size: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The cell (of ``count``) of each of ``size`` pixels, and the position in the cell, 0..1."""
    position = (np.arange(size) + 0.5) * (count / size)
    cell = np.minimum(position.astype(np.int32), count - 1)
    return cell, (position - cell).astype(np.float32)
