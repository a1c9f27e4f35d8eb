"""The name of the scene as an image, for the plate on the base: `engraving`."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from snowsplat.extras.globe.dimensions import BASE
from snowsplat.extras.globe.glass import PLATE

_WIDTH = 1024  # pixels
_HEIGHT = round(_WIDTH * PLATE[1] / (PLATE[0] * BASE[1].radius))
_LARGEST, _SMALLEST = round(0.5 * _HEIGHT), 12  # size of the letters
_MARGIN = 0.86  # the text fills at most this share of the width


def engraving(name: str) -> np.ndarray:
    """(h, w) float32 in 0..1: 1 where the plate is engraved. A long name has smaller letters.

    Letters that the font of Pillow does not have are drawn as boxes.
    """
    image = Image.new("L", (_WIDTH, _HEIGHT))
    draw = ImageDraw.Draw(image)
    for points in range(_LARGEST, _SMALLEST - 1, -2):
        font = ImageFont.load_default(points)
        if draw.textlength(name, font) <= _MARGIN * _WIDTH:
            break
    draw.text((_WIDTH / 2, 0.52 * _HEIGHT), name, font=font, anchor="mm", fill=255)
    return np.asarray(image, dtype=np.float32) / 255.0
