"""photometric on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import Kernel, Run

KERNELS: dict[str, Kernel] = {
    "photometric_similarity": Kernel("photometric", threads=192, items=1),
    "photometric_similarity_u8": Kernel("photometric", threads=192, items=1),
    "photometric_gradient": Kernel("photometric", threads=192, items=1),
    "photometric_gradient_u8": Kernel("photometric", threads=192, items=1),
    "photometric_means": Kernel("photometric", threads=256, items=256),
}

_TILE_WIDTH = 32
_TILE_HEIGHT = {"": 24, "_f64": 12}
_MAPS_BYTES = 32 << 20  # of derivatives at a time, or those of one channel


def _photometric(
    target_suffix: str,
    run: Run,
    suffix: str,
    channels: int,
    width: int,
    height: int,
    image: Tensor,
    target: Tensor,
    l1_weight: float,
    ssim_weight: float,
    grad: Tensor | None,
    means: Tensor,
) -> int:
    tiles = -(-width // _TILE_WIDTH) * -(-height // _TILE_HEIGHT[suffix])  # of a channel
    sums = torch.empty(channels * tiles, 2, dtype=torch.float64, device=image.device)
    values = channels * width * height
    some, maps = channels, None
    if grad is not None:
        size = 3 * width * height * image.element_size()
        some = max(1, min(channels, _MAPS_BYTES // size))
        maps = torch.empty(some * 3 * width * height, dtype=image.dtype, device=image.device)
    for first in range(0, channels, some):
        last = min(first + some, channels)
        shape = last - first, width, height
        images = image[first:last], target[first:last]
        blocks = (last - first) * tiles
        name = f"photometric_similarity{target_suffix}{suffix}"
        run(name, blocks, *shape, *images, maps, sums[first * tiles :])
        if grad is not None:
            name = f"photometric_gradient{target_suffix}{suffix}"
            weights = l1_weight / values, ssim_weight / values
            run(name, blocks, *shape, *images, maps, *weights, grad[first:last])
    run("photometric_means", 1, channels * tiles, sums, values, means)
    return 0


SEQUENCES: dict[str, Callable[..., int]] = {
    "photometric": partial(_photometric, ""),
    "photometric_u8": partial(_photometric, "_u8"),
}
