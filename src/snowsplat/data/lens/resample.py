"""Resamples photos and masks for a `Pinhole`. The centre of the first pixel is at (0.5, 0.5).

Photos are sampled with Catmull-Rom splines, which have at most a quarter of the error of bilinear
interpolation. Training uses every pixel, so blur added here would limit its quality.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from snowsplat.data.lens.pinhole import Pinhole

_STRIP_PIXELS = 1 << 16  # processed at a time: limits the memory and fits the caches


def undistort_image(image: Image.Image, pinhole: Pinhole) -> Image.Image:
    """A photo, "L", "RGB" or "RGBA", resampled to the pinhole camera; same mode."""
    if pinhole.nodes is None:
        return image
    # Premultiplied alpha, so that the colours of transparent pixels do not affect other pixels.
    mode = "RGBa" if image.mode == "RGBA" else image.mode
    pixels = np.asarray(image.convert(mode)).reshape(image.height, image.width, -1)
    made = np.empty((pinhole.height, pinhole.width, pixels.shape[2]), np.uint8)
    for rows, strip, position in _strips(pixels, pinhole):
        made[rows] = _catmull_rom(strip, position).round().clamp(0, 255).byte().numpy()
    return Image.frombytes(mode, (pinhole.width, pinhole.height), made.tobytes()).convert(
        image.mode
    )


def undistort_mask(mask: Image.Image, pinhole: Pinhole) -> Image.Image:
    """A mask, "L", resampled to the pinhole camera: 255 where at least half of a pixel is set."""
    if pinhole.nodes is not None:
        pixels = np.asarray(mask)[..., None]
        made = np.empty((pinhole.height, pinhole.width), np.uint8)
        for rows, strip, position in _strips(pixels, pinhole):
            made[rows] = _sample(strip, position, "bilinear")[..., 0].round().byte().numpy()
        mask = Image.fromarray(made)
    return mask.point(lambda value: 255 * (value >= 128))


def _strips(pixels: np.ndarray, pinhole: Pinhole) -> Iterator[tuple[slice, Tensor, Tensor]]:
    """Divide the new image into strips of H rows; yields three values for each strip.

    - the rows of the strip in the new image;
    - the part (1, C, h, w) float32 of the photo that contains the pixels they need;
    - the positions (1, H, W, 2) float64 of the pixels of the strip: x, y in pixels of that part.
    """
    nodes = pinhole.nodes
    assert nodes is not None
    height = pixels.shape[0]
    column, across = _cells(pinhole.width, nodes.shape[1] - 1)
    row, down = _cells(pinhole.height, nodes.shape[0] - 1)
    across, down = across[:, None], down[:, None, None]
    step = max(1, _STRIP_PIXELS // pinhole.width)
    for first in range(0, pinhole.height, step):
        rows = slice(first, min(first + step, pinhole.height))
        lines = nodes[row[rows]] * (1 - down[rows]) + nodes[row[rows] + 1] * down[rows]
        position = lines[:, column] * (1 - across) + lines[:, column + 1] * across
        top = int(np.clip(position[..., 1].min() - 3, 0, height - 1))
        bottom = int(np.clip(position[..., 1].max() + 3, top + 1, height))
        part = torch.from_numpy(pixels[top:bottom].astype(np.float32)).permute(2, 0, 1)[None]
        position -= (0, top)
        yield rows, part, torch.from_numpy(position)[None]


def _cells(size: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The cell (of ``count``) of each of ``size`` pixels, and the position in the cell, 0..1."""
    position = (np.arange(size) + 0.5) * (count / size)
    cell = np.minimum(position.astype(np.int64), count - 1)
    return cell, position - cell


def _catmull_rom(part: Tensor, position: Tensor) -> Tensor:
    """(H, W, C) float32 of a part (1, C, h, w) at positions (1, H, W, 2).

    Kernels of cubic convolution have a free parameter a: the kernel is K₀ + a·G. PyTorch's bicubic
    mode uses a = −0.75, which sharpens. Catmull-Rom uses a = −0.5, which is exact for quadratics
    (Keys 1981). So the kernel of Catmull-Rom is 1/3 of K₀ plus 2/3 of PyTorch's. K₀ uses two
    pixels: it is bilinear interpolation with each fraction f replaced by 3f² − 2f³. (Here the
    results of the 2D interpolations are added instead of the 1D kernels. This leaves an error of
    the fourth order.)
    """
    whole = torch.floor(position - 0.5)
    fraction = position - 0.5 - whole
    bent = whole + 0.5 + fraction * fraction * (3 - 2 * fraction)
    return (2 * _sample(part, position, "bicubic") + _sample(part, bent, "bilinear")) / 3


def _sample(part: Tensor, position: Tensor, how: str) -> Tensor:
    """(H, W, C) float32: ``part`` interpolated at ``position``; its border pixels are repeated."""
    size = torch.tensor([part.shape[3], part.shape[2]], dtype=position.dtype)
    grid = (2 * position / size - 1).float()
    made = F.grid_sample(part, grid, mode=how, padding_mode="border", align_corners=False)
    return made[0].permute(1, 2, 0)
