"""Counts the elements of a frame exactly, independent of the kernels.

- splat: a Gaussian that the camera sees;
- instance: a (tile, splat) in the lists of the tiles;
- pair: a (pixel, splat) that is blended: α ≥ 1/255, and the pixel is not finished. It is the unit
  of work that every method must do;
- step: a vector of W neighbouring pixels that the kernels process for one splat. Lanes without a
  pair (outside of the ellipse or the image, or finished) are idle: the lane use is
  pairs / (W · steps).
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from snowsplat.ops import Splats2D
from snowsplat.util.native_layout import TILE

ALPHA_MIN, ALPHA_MAX, LEAST_LIGHT = 1 / 255, 0.99, 1e-4
#: Pixels per vector, in float32.
LANES = {"avx512": 16, "avx2": 8, "baseline": 4}


def frame_of(image: Tensor) -> Any:
    """The lists that blending used, which are stored for the backward pass of ``image``."""
    nodes = [image.grad_fn]
    while nodes:
        node = nodes.pop()
        if node is None:
            continue
        if hasattr(node, "frame"):
            return node.frame
        nodes += [before for before, _ in node.next_functions]
    raise AssertionError("no frame in the graph of the image: ops.rasterize keeps it elsewhere")


def count_steps(frame: Any) -> dict[str, int]:
    """Number of instances, of those visited by blending, and of its vector steps (one pass)."""
    start, end = _numbers(frame.params["tile_start"]), _numbers(frame.params["tile_end"])
    bits_each = 8 * frame.params["instance_blocks"].numel() // max(1, frame.instances)
    bits = np.unpackbits(frame.params["instance_blocks"].numpy()).reshape(-1, bits_each).sum(axis=1)
    before = np.concatenate([[0], np.cumsum(bits)])  # bits beyond a tile's end are undefined
    return {
        "instances": int(frame.instances),
        "visited": int((end - start[:-1]).sum()),
        "steps": int((before[end] - before[start[:-1]]).sum()),
    }


def count_pairs(splats: Splats2D, frame: Any, width: int, height: int) -> int:
    """Number of blended (pixel, splat) pairs, by the definition, from the frame's tile lists."""
    start, end = _numbers(frame.params["tile_start"]), _numbers(frame.params["tile_end"])
    splat_of = frame.params["instance_splat"].long()
    rows = splats.packed.detach()[:, :6]
    tiles_x = -(-width // TILE)
    pairs = 0
    for tile in np.flatnonzero(end > start[:-1]):
        left, top = int(tile) % tiles_x * TILE, int(tile) // tiles_x * TILE
        here = rows[splat_of[int(start[tile]) : int(end[tile])]]
        x = torch.arange(left, min(left + TILE, width)) + 0.5
        y = torch.arange(top, min(top + TILE, height)) + 0.5
        pairs += _pairs_of_tile(here, x, y)
    return pairs


def _pairs_of_tile(rows: Tensor, x: Tensor, y: Tensor, chunk: int = 64) -> int:
    """Pairs of a tile, front to back; rows (M, 6) are x, y, a, b, c, opacity of its splats."""
    light = torch.ones(len(y), len(x))
    unfinished = torch.ones(len(y), len(x), dtype=torch.bool)
    pairs = 0
    for first in range(0, len(rows), chunk):
        mean_x, mean_y, a, b, c, opacity = rows[first : first + chunk].T[:, :, None, None]
        dx, dy = x[None, None, :] - mean_x, y[None, :, None] - mean_y
        alpha = opacity * torch.exp((-0.5 * a) * (dx * dx) + (-0.5 * c) * (dy * dy) - b * (dx * dy))
        seen = alpha >= ALPHA_MIN
        through = torch.where(seen, 1 - alpha.clamp(max=ALPHA_MAX), 1.0)
        after = torch.cumprod(through, dim=0) * light
        # Transmittance only decreases: once it is too small, no further splat is blended.
        blended = (after >= LEAST_LIGHT) & unfinished
        pairs += int((seen & blended).sum())
        light, unfinished = after[-1], blended[-1]
        if not unfinished.any():
            break
    return pairs


def _numbers(tensor: Tensor) -> np.ndarray:
    return tensor.numpy().astype(np.int64)
