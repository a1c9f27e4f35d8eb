"""What moves in the photos: the masks that the training found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

from snowsplat.data import ImageLoader, View
from snowsplat.training.report.pictures import reduced

#: Largest number of photos that are shown: those with the largest masks.
_SHOWN = 12
#: The colour of masked parts, and its share.
_TINT, _SHARE = (255.0, 0.0, 200.0), 0.6


@dataclass(frozen=True)
class Masked:
    """A photo with its masked parts tinted, and their share of it, 0..1."""

    name: str
    image: Image.Image
    share: float


def masked(views: Sequence[View], masks: Mapping[str, Image.Image]) -> list[Masked]:
    """Photos in which something moves: those with the largest masks, the largest first.

    Args:
        views: the training views.
        masks: by the name of the view, of the size of its photo: 0 where something moves.

    Raises: UserError: a photo is missing or damaged.
    """
    if not masks:
        return []
    shares = {name: 1.0 - float(np.asarray(mask).mean()) / 255.0 for name, mask in masks.items()}
    largest = sorted(masks, key=lambda name: -shares[name])[:_SHOWN]
    by_name = {view.name: view for view in views}
    found = []
    with ImageLoader(views, background=(0.0, 0.0, 0.0)) as loader:
        for name in largest:
            photo = loader.get(by_name[name]).rgb.numpy().astype(np.float32)
            tinted = (1.0 - _SHARE) * photo + _SHARE * np.array(_TINT, np.float32)
            moves = np.asarray(masks[name])[:, :, None] == 0
            pixels = np.where(moves, tinted, photo).round().astype(np.uint8)
            found.append(Masked(name, reduced(pixels), shares[name]))
    return found
