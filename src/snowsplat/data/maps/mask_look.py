"""What masks look like as a whole: whether they ignore nearly all, or the wrong side.

Programs do not agree whether black or white marks what to ignore. Here it is black.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snowsplat.data.maps.mask_pixels import MASK_FORMATS, mask_levels
from snowsplat.data.photos.image_file import open_image

# The share of a typical photo below which hardly anything is used.
_LITTLE = 0.05
# Photographers aim at their subject. Masks that keep a border of nearly all photos completely and
# ignore their middle keep what is around the subject.
_FEWEST_MASKS = 5
_MOST_PHOTOS = 0.8
_IGNORED, _KEPT = 0.1, 0.98
# Masks are placed where something is to see, and so are the points of a model. In what masks keep
# there are not far fewer points than elsewhere.
_FEWER_POINTS = 0.25
# Mask files that are decoded to judge all.
_SAMPLE = 16
#: What to do about masks that are the wrong way round.
INVERT = "black pixels of a mask are ignored: if black marks what to keep, invert the masks"


@dataclass(frozen=True)
class MaskLook:
    """Shares of the pixels that a mask keeps, from 0 to 1."""

    kept: float  # of all pixels
    middle: float  # of those in the middle, a third of the width and of the height
    border: float  # of those in the rim, a sixteenth of the width and of the height


def look_of(used: np.ndarray) -> MaskLook:
    """The look of a mask (H, W) bool, True for pixels that are used."""
    height, width = used.shape
    middle = used[height // 3 : -(-2 * height // 3), width // 3 : -(-2 * width // 3)]
    y, x = -(-height // 16), -(-width // 16)
    rim = np.concatenate(
        [part.ravel() for part in (used[:y], used[-y:], used[:, :x], used[:, -x:])]
    )
    return MaskLook(*(round(float(part.mean()), 4) for part in (used, middle, rim)))


def doubt_about_masks(looks: Sequence[MaskLook], points_kept: float | None = None) -> str | None:
    """What is doubtful about masks, in one sentence; None if nothing is.

    Args:
        looks: of all masks of a dataset, or of a sample.
        points_kept: the share of the points in the photos that lie on pixels that masks keep; None
            if it is not known.
    """
    if not looks:
        return None
    kept = float(np.median([look.kept for look in looks]))
    if kept < _LITTLE:
        return f"the masks ignore {_percent(1 - kept)} of a typical photo; {INVERT}"
    if points_kept is not None and points_kept < _FEWER_POINTS * kept:
        return (
            f"the masks keep {_percent(kept)} of a typical photo, but only {_percent(points_kept)} "
            f"of the points of the model are there; {INVERT}"
        )
    around = sum(look.middle <= _IGNORED and look.border >= _KEPT for look in looks)
    if len(looks) >= _FEWEST_MASKS and around >= _MOST_PHOTOS * len(looks):
        return f"the masks keep the border of most photos and ignore their middle; {INVERT}"
    return None


def doubt_about_files(masks: Sequence[Path]) -> str | None:
    """What is doubtful about mask files, by a sample; files that cannot be read are left out."""
    chosen = np.unique(np.linspace(0, len(masks) - 1, min(len(masks), _SAMPLE)).astype(int))
    looks = []
    for path in (masks[i] for i in chosen):
        with suppress(Exception), open_image(path, MASK_FORMATS) as image:
            looks.append(look_of(mask_levels(image) >= 128))
    return doubt_about_masks(looks)


def _percent(share: float) -> str:
    return f"{100 * share:.0f}%" if 0.01 <= share <= 0.99 else f"{100 * share:.2g}%"
