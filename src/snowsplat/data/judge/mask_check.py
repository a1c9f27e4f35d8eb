"""`mask_findings`: whether the masks of a dataset ignore everything, or the wrong side."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from snowsplat.data.dataset import Points, View
from snowsplat.data.judge.lens_check import Finding
from snowsplat.data.judge.rig import Rig
from snowsplat.data.maps.mask_pixels import INVERT, doubt_about_masks, look_of
from snowsplat.data.photos.decode import ImageSource, load_mask
from snowsplat.data.photos.image_loader import each_photo
from snowsplat.scene.camera import Camera
from snowsplat.util.errors import UserError
from snowsplat.util.image_size import scaled_size
from snowsplat.util.messages import message

# Masks that are decoded, spread over the dataset, and the longer side of their small copies.
_MOST_MASKS, _SIDE = 16, 128
# Points that are projected into each photo, and those that must be seen to say something.
_MOST_POINTS, _FEWEST_SEEN = 5000, 200


def mask_findings(views: Sequence[View], points: Points | None) -> list[Finding]:
    """What is impossible or doubtful about the masks of a dataset; decodes up to 16 of them."""
    masked = [(view.camera, view.mask) for view in views if view.mask is not None]
    chosen = np.unique(np.linspace(0, len(masked) - 1, min(len(masked), _MOST_MASKS)).astype(int))
    sample = [masked[i] for i in chosen]
    decoded = each_photo(lambda pair: _small(*pair), sample)
    used = [(camera, mask) for camera, mask in decoded if mask is not None]
    if not used:
        return []
    if not any(mask.any() for _, mask in used):
        nothing = message(
            "the masks ignore every pixel of every photo ({count} were looked at)", count=len(used)
        )
        return [Finding("masks", nothing, INVERT, impossible=len(masked) == len(views))]
    looks = [look_of(mask) for _, mask in used]
    doubt = doubt_about_masks(looks, None if points is None else _points_kept(used, points))
    return [] if doubt is None else [Finding("masks", doubt)]


def _small(camera: Camera, mask: ImageSource) -> tuple[Camera, np.ndarray | None]:
    size = scaled_size(mask.width, mask.height, _SIDE)
    try:
        small = load_mask(dataclasses.replace(mask, width=size[0], height=size[1])).numpy()
    except UserError:  # the training says so
        return camera, None
    return camera.scaled(*size), small


def _points_kept(used: Sequence[tuple[Camera, np.ndarray]], points: Points) -> float | None:
    """The share of the points in the photos that lie on pixels that masks keep."""
    chosen = np.random.default_rng(0).permutation(len(points))[:_MOST_POINTS]
    xyz = points.xyz.numpy()[chosen].astype(np.float64)
    rig = Rig.of([camera for camera, _ in used])
    seen, kept = 0, 0
    for view, (_, mask) in enumerate(used):
        _, where, _ = rig.inside(view, xyz)
        column, row = (where * mask.shape[::-1]).astype(int).T
        seen += len(where)
        kept += int(mask[row, column].sum())
    return kept / seen if seen >= _FEWEST_SEEN else None
