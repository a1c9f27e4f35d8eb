"""The photos and the points of each block.

As in VastGaussian (Lin et al. 2024, arXiv:2402.17427), a block is trained with the photos that
were taken in its expanded cell, and with those that show it. So that its Gaussians do not have to
explain what the photos show outside of it, it is also trained with points from there.

The ground plane is cut into cells with equal shares of the cameras and of the points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.ops import neighbours

# A photo belongs to a block if at least this share of what it shows is in the cell.
_SHOWN = 0.25
# Points that are projected to find out what photos show.
_SAMPLE = 20_000
# Largest spacing of points in a photo, relative to their depth. Single points are farther apart.
_WIDEST = 0.1
# Photos of a block that are tested for whether they show a point outside of it.
_TESTED_VIEWS = 200
# Points outside of the expanded cell, as a share of those inside.
_OUTSIDE = 0.25
# Additional photos, spread over the rest of the scene, as a share of the others.
_FAR_VIEWS = 0.2
#: The two axes of the ground plane, unit vectors in the world frame.
Axes = tuple[tuple[float, float, float], tuple[float, float, float]]
# The size of a cell in a direction is the distance between these quantiles of its content.
# Distant points, such as those of the sky, would make it too large.
_INNER = (0.05, 0.95)


@dataclass(frozen=True)
class BlockContent:
    """A block."""

    cell: Cell
    views: list[View]  # training photos of the whole dataset
    points: Points | None  # of the dataset; None if it has none
    # Of the Gaussians of the whole scene, those that the training of the block needs, including
    # those outside of its cell.
    share: float


def block_content(dataset: Dataset, count: int, margin: float) -> tuple[Axes, list[BlockContent]]:
    """Cut a dataset into ``count`` blocks.

    The cell of a block is expanded by ``margin`` times its size. The views of the block are

    - the views whose cameras are in the expanded cell,
    - the views of whose image at least a quarter shows the cell,
    - a fifth as many views from the rest of the scene, evenly spread, because some parts of the
      cell, such as high roofs, are seen only from afar.

    The points of the block are the points in the expanded cell and, a quarter as many, a random
    selection of the other points that these views show.

    Returns the axes of the ground plane, and the blocks in the order of `cut`.
    """
    views = dataset.train
    positions = torch.stack([view.camera.position for view in views]).to(torch.float64)
    axes = ground_axes(positions)
    points = dataset.points
    xyz = torch.zeros(0, 3, dtype=torch.float64) if points is None else points.xyz.double()
    generator = torch.Generator().manual_seed(0)
    sample = xyz[torch.randperm(len(xyz), generator=generator)[:_SAMPLE]]
    cameras, ground = positions @ axes.T, xyz @ axes.T
    cells = cut(cameras, ground, count)
    shown = _shown(views, sample, cells, sample @ axes.T)
    blocks = []
    for number, cell in enumerate(cells):
        inside = torch.cat([cameras[cell.contains(cameras)], ground[cell.contains(ground)]])
        border = [margin * side for side in extent(inside)]
        used = cell.contains(cameras, border) | (shown[:, number] >= _SHOWN)
        far = (~used).nonzero()[:, 0]
        added = min(len(far), round(_FAR_VIEWS * int(used.sum())))
        used[far[torch.linspace(0, len(far) - 1, added).long()]] = True
        own = [view for view, is_used in zip(views, used.tolist(), strict=True) if is_used]
        if points is None:
            blocks.append(BlockContent(cell, own, None, len(own) / len(views)))
            continue
        kept = cell.contains(ground, border)
        others = (~kept).nonzero()[:, 0]
        some = own[:: -(-len(own) // _TESTED_VIEWS)]
        seen = [view.camera.sees(xyz[others])[1] for view in some]
        others = others[torch.stack(seen).any(0)]
        chosen = torch.randperm(len(others), generator=generator)
        kept[others[chosen[: round(_OUTSIDE * int(kept.sum()))]]] = True
        selected = Points(points.xyz[kept], points.rgb[kept])
        blocks.append(BlockContent(cell, own, selected, len(selected) / len(xyz)))
    first, second = (tuple(axis) for axis in axes.tolist())
    return (first, second), blocks


def _shown(views: list[View], xyz: Tensor, cells: list[Cell], ground: Tensor) -> Tensor:
    """(V, B): the share of what each view shows that is in each cell.

    A point stands for the part of a surface around it. Its area in the image is proportional to the
    squared distance to the next points, divided by the squared depth. Occlusion is not considered.
    """
    spacing = neighbours(xyz)[:, -1].clamp(max=1e30) if len(xyz) else xyz.new_zeros(0)
    members = torch.stack([cell.contains(ground) for cell in cells], 1).to(torch.float64)
    rows = []
    for view in views:
        depth, visible = view.camera.sees(xyz)
        angle = spacing / torch.where(visible, depth, 1.0)
        weights = angle.clamp(max=_WIDEST).square() * visible
        rows.append(weights @ members / weights.sum().clamp(min=1e-300))
    return torch.stack(rows)


@dataclass(frozen=True)
class Cell:
    """A half-open box of the ground plane, low <= x < high; None: it is not limited there.

    Neighbours share a border, and the outermost cells have no limit: every point of the plane is
    in exactly one cell.
    """

    low: tuple[float | None, float | None] = (None, None)
    high: tuple[float | None, float | None] = (None, None)

    def contains(self, ground: Tensor, margin: Sequence[float] | Tensor = (0.0, 0.0)) -> Tensor:
        """(N,) bool: the points (N, 2) of the plane that are in the cell.

        ``margin``: by which the cell is expanded in both directions; or one for each point, (N, 2).
        """
        margins = torch.as_tensor(margin, dtype=torch.float64).expand(len(ground), 2)
        inside = torch.ones(len(ground), dtype=torch.bool)
        for axis in range(2):
            low, high = self.low[axis], self.high[axis]
            if low is not None:
                inside &= ground[:, axis] >= low - margins[:, axis]
            if high is not None:
                inside &= ground[:, axis] < high + margins[:, axis]
        return inside

    def split(self, axis: int, at: float) -> tuple[Cell, Cell]:
        """The parts below and above ``at``."""

        def changed(values: tuple[float | None, float | None]) -> tuple[float | None, float | None]:
            return (at, values[1]) if axis == 0 else (values[0], at)

        return replace(self, high=changed(self.high)), replace(self, low=changed(self.low))


def ground_axes(positions: Tensor) -> Tensor:
    """(2, 3) float64: the two directions in which the camera centres (C, 3) vary most."""
    offsets = positions.to(torch.float64)
    offsets = offsets - offsets.mean(0)
    _, directions = torch.linalg.eigh(offsets.T @ offsets)  # ascending
    axes = directions.T.flip(0)[:2]
    # The sign of an eigenvector is arbitrary. Its largest component is made positive.
    largest = axes.gather(1, axes.abs().argmax(1, keepdim=True))
    return axes * largest.sign()


def cut(cameras: Tensor, points: Tensor, count: int) -> list[Cell]:
    """``count`` cells with about equal content, ordered along the first direction.

    Half of the content are the cameras (C, 2), the other half the points (P, 2). A cell is halved
    across the direction in which its content is longer, until there are ``count`` cells.
    """
    ground = torch.cat([cameras, points]).to(torch.float64)
    sizes = torch.tensor([len(cameras), len(points)])
    weights = (1.0 / sizes.clamp(min=1).double()).repeat_interleave(sizes)
    return _cut(Cell(), ground, weights, count)


def extent(ground: Tensor) -> tuple[float, float]:
    """The size of the inner part of points (N, 2) in both directions; 0 without points."""
    if not len(ground):
        return 0.0, 0.0
    ordered = ground.sort(0).values
    low, high = (ordered[round(share * (len(ordered) - 1))] for share in _INNER)
    x, y = (high - low).tolist()
    return x, y


def _cut(cell: Cell, ground: Tensor, weights: Tensor, count: int) -> list[Cell]:
    if count == 1:
        return [cell]
    size = extent(ground)
    axis = 0 if size[0] >= size[1] else 1
    below = count // 2
    at = _quantile(ground[:, axis], weights, below / count)
    low, high = cell.split(axis, at)
    is_low = ground[:, axis] < at
    return [
        *_cut(low, ground[is_low], weights[is_low], below),
        *_cut(high, ground[~is_low], weights[~is_low], count - below),
    ]


def _quantile(values: Tensor, weights: Tensor, share: float) -> float:
    """A value with this share of the weight below it; between two values, if they differ."""
    ordered, index = values.sort()
    total = weights[index].cumsum(0)
    found = int(torch.searchsorted(total, share * float(total[-1])).clamp(0, len(values) - 2))
    at = float((ordered[found] + ordered[found + 1]) / 2)
    assert math.isfinite(at)
    return at
