"""`ExposedImages`: images with the gains of their photos, at most white where a photo is.

A photo that is overexposed only says that the image is at least as bright. Few values are, so a
step visits only them. Everything else is one pass over the image, and one over its gradient.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from snowsplat.data.photos.decode import LoadedImage
from snowsplat.ops import scratch

#: 8-bit values from this one on are overexposed.
_OVEREXPOSED = 254
#: Positions take 8 bytes each. They are kept if this is at most so many times the photo's memory.
_KEPT = 2


class ExposedImages:
    """Multiplies images by gains. It remembers where the photos are overexposed."""

    def __init__(self) -> None:
        self._kept: dict[tuple[int, int], Tensor] = {}

    def exposed(
        self, image: Tensor, log_gains: Tensor, photo: LoadedImage, index: int | None
    ) -> Tensor:
        """exp(log_gains) · image, at most 1 where the photo is overexposed; differentiable.

        Args:
            image: (H, W, 3), planar in memory.
            log_gains: (3,) on the device of the image.
            photo: has the same colours at each call with the same ``index`` and size; None: it may
                have others.
        """
        if image.device.type == "cpu":
            at = self._positions(photo, None if index is None else (index, image.shape[0]))
        else:  # a GPU would wait for the number of positions
            at = photo.planes[:3] >= _OVEREXPOSED
        result: Tensor = _Exposed.apply(image, log_gains, at)
        return result

    def _positions(self, photo: LoadedImage, key: tuple[int, int] | None) -> Tensor:
        """(K,) int64: where the planes of the colours are overexposed."""
        at = None if key is None else self._kept.get(key)
        if at is None:
            colors = photo.planes[:3].reshape(-1)
            at = (colors >= _OVEREXPOSED).nonzero()[:, 0]
            if key is not None and at.nbytes <= _KEPT * colors.nbytes:
                self._kept[key] = at
        return at


class _Exposed(torch.autograd.Function):
    """The image that `ExposedImages.exposed` returns.

    ``at``: where the photo is overexposed: from `_positions`, or (3, H, W) bool.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, log_gains: Tensor, at: Tensor) -> Tensor:
        gains = log_gains.exp()
        planes = _product(image, gains)
        if at.dtype == torch.bool:
            ctx.limited = at & (planes > 1.0)
            planes.masked_fill_(ctx.limited, 1.0)
        else:
            values = planes.view(-1).index_select(0, at)
            planes.view(-1).scatter_(0, at, values.clamp(max=1.0))
            ctx.limited, ctx.at, ctx.unlimited = None, at, (values <= 1.0).to(planes.dtype)
        ctx.save_for_backward(image, gains)
        return planes.permute(1, 2, 0)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        image, gains = ctx.saved_tensors
        planes = _product(grad, gains)
        values = image.permute(2, 0, 1).reshape(3, -1)
        if ctx.limited is not None:
            planes.masked_fill_(ctx.limited, 0.0)
            grad_gains = (planes.view(3, -1) * values).sum(1)
        else:
            flat = planes.view(-1)
            flat.scatter_(0, ctx.at, flat.index_select(0, ctx.at) * ctx.unlimited)
            pairs = zip(planes.view(3, -1), values, strict=True)
            grad_gains = torch.stack([torch.dot(*pair) for pair in pairs])
        return planes.permute(1, 2, 0), grad_gains, None


def _product(image: Tensor, gains: Tensor) -> Tensor:
    """(3, H, W): an image (H, W, 3) times (3,), in memory that the next step uses again."""
    planes = image.permute(2, 0, 1)
    return torch.mul(planes, gains[:, None, None], out=scratch.empty_like(planes))
