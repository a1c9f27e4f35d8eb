"""`photometric_loss` and `ssim` on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from snowsplat.ops.cuda.kernels import Kernel, Run
from snowsplat.ops.params import PhotometricParams
from snowsplat.util.native_layout import Params


@dataclass(slots=True, kw_only=True)
class PhotometricSimilarityParams(Params):
    n: int
    width: int
    height: int
    image: Tensor
    target: Tensor
    maps: Tensor | None
    sums: Tensor


@dataclass(slots=True, kw_only=True)
class PhotometricGradientParams(Params):
    n: int
    width: int
    height: int
    image: Tensor
    target: Tensor
    maps: Tensor
    l1_weight: float
    ssim_weight: float
    huber_weight: float
    grad: Tensor


@dataclass(slots=True, kw_only=True)
class PhotometricMeansParams(Params):
    n: int
    sums: Tensor
    values: int
    means: Tensor


KERNELS: dict[str, Kernel] = {
    **{
        f"photometric_similarity{target}": Kernel(
            "photometric", PhotometricSimilarityParams, threads=192, items=1
        )
        for target in ("", "_u8")
    },
    **{
        f"photometric_gradient{target}": Kernel(
            "photometric", PhotometricGradientParams, threads=192, items=1
        )
        for target in ("", "_u8")
    },
    "photometric_means": Kernel("photometric", PhotometricMeansParams, threads=256, items=256),
}

_TILE_WIDTH = 32
_TILE_HEIGHT = {"": 24, "_f64": 12}
_MAPS_BYTES = 32 << 20  # maximum size of the maps of derivatives, if at least one channel fits


def _photometric(target_suffix: str, run: Run, suffix: str, p: PhotometricParams) -> int:
    channels, width, height = p.n, p.width, p.height
    tiles = -(-width // _TILE_WIDTH) * -(-height // _TILE_HEIGHT[suffix])  # of a channel
    device, dtype = p.image.device, p.image.dtype
    sums = torch.empty(channels * tiles, 3, dtype=torch.float64, device=device)
    values = channels * width * height
    at_once = channels
    if p.grad is not None:
        size = 3 * width * height * p.image.element_size()
        at_once = max(1, min(channels, _MAPS_BYTES // size))
        maps = torch.empty(at_once * 3 * width * height, dtype=dtype, device=device)
    for first in range(0, channels, at_once):
        last = min(first + at_once, channels)
        blocks = (last - first) * tiles
        run(
            f"photometric_similarity{target_suffix}{suffix}",
            blocks,
            PhotometricSimilarityParams(
                n=last - first,
                width=width,
                height=height,
                image=p.image[first:last],
                target=p.target[first:last],
                maps=None if p.grad is None else maps,
                sums=sums[first * tiles :],
            ),
        )
        if p.grad is not None:
            run(
                f"photometric_gradient{target_suffix}{suffix}",
                blocks,
                PhotometricGradientParams(
                    n=last - first,
                    width=width,
                    height=height,
                    image=p.image[first:last],
                    target=p.target[first:last],
                    maps=maps,
                    l1_weight=p.l1_weight / values,
                    ssim_weight=p.ssim_weight / values,
                    huber_weight=p.huber_weight / values,
                    grad=p.grad[first:last],
                ),
            )
    means = PhotometricMeansParams(n=channels * tiles, sums=sums, values=values, means=p.means)
    run("photometric_means", 1, means)
    return 0


SEQUENCES: dict[str, Callable[..., int]] = {
    "photometric": partial(_photometric, ""),
    "photometric_u8": partial(_photometric, "_u8"),
}
