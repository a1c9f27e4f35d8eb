"""`plain_pixels`: what every reader of a photo does with its pixels."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from snowsplat.data.bit_depth import eight_bits
from snowsplat.data.colour_profile import to_srgb


def plain_pixels(image: Image.Image, path: Path) -> Image.Image:
    """An image of 8 bits per channel in sRGB: mode L, RGB, or RGBA if pixels may be transparent.

    Args:
        image: opened, not decoded.
        path: its file.

    Raises:
        ValueError: floating-point pixels.
        Exception: anything that Pillow raises for a damaged file.
    """
    return to_srgb(eight_bits(image, path), path)
