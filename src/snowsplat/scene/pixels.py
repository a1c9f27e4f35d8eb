"""Images as pixels of 8 bits, and numbers as colours of a map."""

from __future__ import annotations

import numpy as np
from torch import Tensor


def to_8bit(image: Tensor) -> np.ndarray:
    """(H, W, 3) in 0..1 -> uint8, rounded to the nearest."""
    return (image.clamp(0.0, 1.0) * 255.0 + 0.5).byte().contiguous().cpu().numpy()


def in_colors(values: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """(H, W) numbers in 0..1 -> (H, W, 3) float32, interpolated between ``colors`` (K, 3)."""
    position = np.clip(values, 0.0, 1.0) * (len(colors) - 1)
    low = np.minimum(position.astype(np.int64), len(colors) - 2)
    share = (position - low)[:, :, None]
    return np.rint(colors[low] * (1.0 - share) + colors[low + 1] * share)
