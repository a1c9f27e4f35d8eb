"""`photometric_loss` and `ssim` on a GPU."""

from __future__ import annotations

import torch

from snowsplat.ops.cuda.kernels import Run
from snowsplat.util.native_layout import Fields

_TILE_WIDTH = 32
_TILE_HEIGHT = {"": 24, "_f64": 12}
_MAPS_BYTES = 32 << 20  # maximum size of the maps of derivatives, if at least one channel fits


def photometric(target_suffix: str, run: Run, suffix: str, p: Fields) -> int:
    """``target_suffix``: "_u8" for a target of bytes, or ""."""
    channels, width, height = p["n"], p["width"], p["height"]
    image, target, grad = p["image"], p["target"], p["grad"]
    tiles = -(-width // _TILE_WIDTH) * -(-height // _TILE_HEIGHT[suffix])  # of a channel
    device, dtype = image.device, image.dtype
    sums = torch.empty(channels * tiles, 3, dtype=torch.float64, device=device)
    values = channels * width * height
    at_once = channels
    if grad is not None:
        size = 3 * width * height * image.element_size()
        at_once = max(1, min(channels, _MAPS_BYTES // size))
        maps = torch.empty(at_once * 3 * width * height, dtype=dtype, device=device)
    for first in range(0, channels, at_once):
        last = min(first + at_once, channels)
        blocks = (last - first) * tiles
        inputs = {
            "n": last - first,
            "width": width,
            "height": height,
            "image": image[first:last],
            "target": target[first:last],
            "maps": None if grad is None else maps,
        }
        similarity = {**inputs, "sums": sums[first * tiles :]}
        run(f"photometric_similarity{target_suffix}{suffix}", similarity, blocks)
        if grad is not None:
            names = ("l1_weight", "ssim_weight", "huber_weight")
            weights = {name: p[name] / values for name in names}
            gradient = {**inputs, **weights, "grad": grad[first:last]}
            run(f"photometric_gradient{target_suffix}{suffix}", gradient, blocks)
    means = {"n": channels * tiles, "sums": sums, "values": values, "means": p["means"]}
    run("photometric_means", means, 1)
    return 0
