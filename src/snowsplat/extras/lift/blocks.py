"""Fewer Gaussians than pixels: uniform parts of the photo share one Gaussian."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from snowsplat.extras.lift.surface import Links

# Width in pixels of the largest block, a power of two.
_LARGEST = 16
# Error of the depth, relative to the depth, that is as bad as an error of 1 of the colour.
_DEPTH_WEIGHT = 10.0
_BISECTIONS = 40


@dataclass(frozen=True)
class Blocks:
    """Square blocks of pixels, disjoint; together they are all pixels with a known depth."""

    owner: Tensor  # (H, W) int64: the block of each pixel; −1 where the depth is unknown
    size: Tensor  # (B,) float32: the width of each block in pixels

    def __len__(self) -> int:
        return len(self.size)

    def mean(self, values: Tensor) -> Tensor:
        """(B, …) the mean over each block of per-pixel values (H, W, …)."""
        known = self.owner >= 0
        sums = values.new_zeros(len(self), *values.shape[2:])
        sums = sums.index_add(0, self.owner[known], values[known])
        return sums / self.size.square().view(-1, *[1] * (values.ndim - 2))


def pixel_blocks(known: Tensor) -> Blocks:
    """A block for each pixel of ``known`` (H, W) bool."""
    return _numbered({1: known})


def merge_pixels(depth: Tensor, photo: Tensor, links: Links, most: int) -> Blocks:
    """At most ``most`` blocks; blocks are large where the photo and the surface are uniform.

    The blocks are the leaves of quadtrees. The error of a block is the sum of the squared
    differences of its pixels from the mean colour, and from the plane through its disparities. A
    block is divided into four if its error is above a limit, or if two neighbouring pixels in it
    are not linked. The limit is found by bisection.

    ``depth`` (H, W) is positive, NaN where it is unknown, ``photo`` (H, W, 3) in 0..1. If too many
    pixels are not linked, the result has more than ``most`` blocks.
    """
    known = depth.isfinite()
    if int(known.sum()) <= most:
        return pixel_blocks(known)
    errors = _errors(depth, photo, links)
    finite = [e[e.isfinite()] for e in errors.values()]
    low, high = 0.0, max(float(e.max()) for e in finite if len(e)) if any(map(len, finite)) else 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        count = sum(int(chosen.sum()) for chosen in _leaves(errors, middle, known).values())
        low, high = (low, middle) if count <= most else (middle, high)
    return _numbered(_leaves(errors, high, known))


def _errors(depth: Tensor, photo: Tensor, links: Links) -> dict[int, Tensor]:
    """The errors of all blocks by their width; infinite for blocks that must be divided."""
    height, width = depth.shape
    pad = (0, -width % _LARGEST, 0, -height % _LARGEST)
    right = F.pad(links.right, (0, 1))  # unlinked at the border; `_tiles` leaves it out there
    down = F.pad(links.down, (0, 0, 0, 1))
    known, right, down = (F.pad(mask, pad) for mask in (depth.isfinite(), right, down))
    disparity = F.pad(torch.nan_to_num(1.0 / depth, nan=1.0), pad, value=1.0)
    channels = [F.pad(channel, pad) for channel in photo.unbind(2)]
    errors = {}
    side = _LARGEST
    while side > 1:
        whole = (
            _tiles(known, side).all((2, 3))
            & _tiles(right, side)[..., :-1].all((2, 3))
            & _tiles(down, side)[..., :-1, :].all((2, 3))
        )
        color = sum(_centred(_tiles(channel, side)).square().sum((2, 3)) for channel in channels)
        tiles = _tiles(disparity, side)
        bend = _off_plane(tiles) * (_DEPTH_WEIGHT / tiles.mean((2, 3))).square()
        errors[side] = torch.where(whole, color + bend, torch.inf)
        side //= 2
    return errors


def _tiles(values: Tensor, side: int) -> Tensor:
    """(H, W) -> (H / side, W / side, side, side)."""
    return values.unfold(0, side, side).unfold(1, side, side)


def _centred(tiles: Tensor) -> Tensor:
    return tiles - tiles.mean((2, 3), keepdim=True)


def _off_plane(tiles: Tensor) -> Tensor:
    """(h, w): the sums of the squared distances of the values from the best plane."""
    side = tiles.shape[2]
    x = torch.arange(side, dtype=tiles.dtype) - 0.5 * (side - 1)
    values = _centred(tiles)
    along_x, along_y = (values * x).sum((2, 3)), (values * x[:, None]).sum((2, 3))
    explained = (along_x.square() + along_y.square()) / (side * x.square().sum())
    return (values.square().sum((2, 3)) - explained).clamp_min(0.0)


def _leaves(errors: dict[int, Tensor], limit: float, known: Tensor) -> dict[int, Tensor]:
    """The chosen blocks by their width, from large to small, as masks of the blocks."""
    chosen = {side: error <= limit for side, error in errors.items()}
    covered = torch.zeros_like(chosen[_LARGEST])
    for side, accepted in chosen.items():
        chosen[side] = accepted & ~covered
        covered = _enlarged(accepted | covered, 2)
    height, width = known.shape
    return chosen | {1: known & ~covered[:height, :width]}


def _enlarged(blocks: Tensor, side: int) -> Tensor:
    """(h, w) -> (h · side, w · side): a value for each pixel of the blocks."""
    return blocks.repeat_interleave(side, 0).repeat_interleave(side, 1)


def _numbered(chosen: dict[int, Tensor]) -> Blocks:
    """The blocks in the order of their width, and in rows; the last masks are those of pixels."""
    height, width = chosen[1].shape
    owner = torch.full((height, width), -1, dtype=torch.int64)
    sizes, count = [], 0
    for side, mask in chosen.items():
        ids = torch.full(mask.shape, -1, dtype=torch.int64)
        ids[mask] = torch.arange(int(mask.sum())) + count
        ids = _enlarged(ids, side)[:height, :width]
        owner = torch.where(ids >= 0, ids, owner)
        sizes += [float(side)] * int(mask.sum())
        count = len(sizes)
    return Blocks(owner, torch.tensor(sizes))
