"""Colour maps: (256, 3) uint8 tables."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def _table(*anchors: tuple[int, int, int]) -> Tensor:
    places = np.linspace(0.0, 255.0, len(anchors))
    columns = [np.interp(np.arange(256), places, column) for column in zip(*anchors, strict=True)]
    return torch.from_numpy(np.rint(np.stack(columns, 1)).astype(np.uint8))


# The lightness of both increases monotonically.
#: From far (violet) through blue and green to near (yellow).
DEPTH = _table(
    (68, 1, 84), (65, 68, 135), (42, 120, 142), (34, 168, 132), (122, 209, 81), (253, 231, 37)
)
#: From small (black) through violet and orange to large (pale yellow).
HEAT = _table(
    (0, 0, 0), (51, 10, 95), (136, 34, 106), (211, 67, 67), (251, 140, 20), (252, 255, 164)
)
