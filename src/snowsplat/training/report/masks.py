"""What moves in the photos: the masks that the training found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image

from snowsplat.data import ImageLoader, View
from snowsplat.training.report.pictures import reduced
from snowsplat.util.html import picture, text

#: Largest number of photos that are shown: those with the largest masks.
_SHOWN = 12
#: The colour of masked parts, and its share.
_TINT, _SHARE = (255.0, 0.0, 200.0), 0.6

#: CSS that the section needs.
STYLE = """
.masks { display: flex; flex-wrap: wrap; gap: 14px 12px; }
.masks img { height: 150px; width: auto; max-width: 100%; border-radius: 3px; }
"""


def masked(views: Sequence[View], masks: Mapping[str, Image.Image]) -> str:
    """HTML of the photos in which something moves, with the masked parts tinted; "" if there are
    none.

    Args:
        views: the training views.
        masks: by the name of the view, of the size of its photo: 0 where something moves.

    Raises: UserError: a photo is missing or damaged.
    """
    if not masks:
        return ""
    shares = {name: 1.0 - float(np.asarray(mask).mean()) / 255.0 for name, mask in masks.items()}
    largest = sorted(masks, key=lambda name: -shares[name])[:_SHOWN]
    by_name = {view.name: view for view in views}
    figures = []
    with ImageLoader(views, background=(0.0, 0.0, 0.0)) as loader:
        for name in largest:
            photo = loader.get(by_name[name]).rgb.numpy().astype(np.float32)
            tinted = (1.0 - _SHARE) * photo + _SHARE * np.array(_TINT, np.float32)
            moves = np.asarray(masks[name])[:, :, None] == 0
            pixels = np.where(moves, tinted, photo).round().astype(np.uint8)
            figures.append(
                f"<figure>{picture(reduced(pixels), f'{name}: masked parts', quality=80)}"
                f"<figcaption>{text(name)}: {100.0 * shares[name]:.1f}%</figcaption></figure>"
            )
    more = len(masks) - len(figures)
    rest = f" {more:,} more are in the folder masks." if more > 0 else ""
    return (
        f"<h2>What moves</h2>\n<p>In {len(masks)} of {len(views)} photos, something looks "
        "different from what the other photos show at this place, for example a person who walks "
        f"past. The tinted parts were not used for training.{rest}</p>\n"
        f'<div class="masks">{"".join(figures)}</div>'
    )
