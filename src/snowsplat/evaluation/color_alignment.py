"""Aligning the colours of an image with those of a photo, so that exposure does not count."""

from __future__ import annotations

import torch
from torch import Tensor


def color_fit(
    image: Tensor, photo: Tensor, mask: Tensor | None = None
) -> tuple[Tensor, Tensor] | None:
    """The gain and the offset of each channel with which an image is most similar to a photo.

    They minimise Σ (gain · image + offset − photo)² over the pixels of the images (H, W, 3) where
    ``mask`` (H, W) is True. A negative gain would invert the image, so it is at least 0.

    Returns gain (3,) and offset (3,), float64; None if the mask leaves no pixel.
    """
    if mask is None:
        x, y = image.flatten(0, 1).double(), photo.flatten(0, 1).double()
    else:
        x, y = image[mask].double(), photo[mask].double()
    if not len(y):
        return None
    mean_x, mean_y = x.mean(0), y.mean(0)
    x, y = x - mean_x, y - mean_y
    gain = (x * y).sum(0) / x.square().sum(0).clamp_min(1e-12)
    gain = gain.clamp_min(0.0)
    return gain, mean_y - gain * mean_x


def color_aligned(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> Tensor:
    """The image (H, W, 3) with the gain and offset of `color_fit`, clamped to 0..1."""
    fit = color_fit(image, photo, mask)
    if fit is None:
        return image
    gain, offset = fit
    return (gain * image.double() + offset).clamp(0.0, 1.0).to(torch.float32)
