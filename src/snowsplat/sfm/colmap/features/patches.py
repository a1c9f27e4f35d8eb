"""Patches: small square images of features, and their alignment with an accuracy below a pixel.

The patches of a point in two photos differ by the viewpoint and the exposure. `align_patches` finds
the affine transform between them by least squares matching (Gruen, "Adaptive least squares
correlation", 1985), with the inverse compositional algorithm of Baker and Matthews ("Lucas-Kanade
20 years on: a unifying framework", IJCV 2004).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from snowsplat.util.native_layout import ALIGNMENT_RADIUS
from snowsplat.util.native_library import call_with_arrays, check_array

Floats = NDArray[np.floating[Any]]

_MARGIN = 6  # pixels on each side of the window, for displacement and distortion
#: Pixels along each side of a patch; the feature is in the middle of the central one.
SIDE = 2 * (ALIGNMENT_RADIUS + _MARGIN) + 1
# Standard deviation of the feature's Gaussian in pixels of its patch, unless this would enlarge the
# photo. Large features are sampled at a lower resolution, so the window covers most of them.
_SCALE_IN_PATCH = 1.5
_AT_ONCE = 256  # patches; the positions of their pixels fit into the cache of the processor


class Aligned(NamedTuple):
    """The transform between the two patches of each of N pairs.

    transform: (N, 2, 3) float32; maps (u, v, 1) in the first patch to the same place in the second
        one. Both positions are in pixels, from the centre of the patch, u to the right and v down.
    correlation: (N,) float32, -1 to 1: of the window of the first patch with the transformed second
        one; -1 if no transform was found.
    """

    transform: NDArray[np.float32]
    correlation: NDArray[np.float32]


def patch_axes(keypoints: Floats) -> Floats:
    """(N, 2, 2) the steps of the patches of ``keypoints`` (N, 6), in pixels of the photo.

    The columns are the steps from one pixel of a patch to the next one, along a row and along a
    column. Patches are turned like their features, so equal features have equal patches.
    """
    frames = keypoints[:, 2:].reshape(-1, 2, 2)
    scale = np.sqrt(np.abs(np.linalg.det(frames)))[:, None, None]
    return np.asarray(frames / scale * np.maximum(1.0, scale / _SCALE_IN_PATCH))


def cut_patches(grey: NDArray[np.uint8], positions: Floats, axes: Floats) -> NDArray[np.uint8]:
    """The patches (N, SIDE, SIDE) around ``positions`` (N, 2) in the photo ``grey`` (H, W).

    In ``positions``, the centre of the first pixel of the photo is (0.5, 0.5). ``axes`` (N, 2, 2)
    is that of `patch_axes`. If a step is 2 pixels or longer, the patch is taken from a reduced
    photo, to prevent aliasing. Outside of the photo, its border is repeated.
    """
    offset = np.arange(SIDE, dtype=np.float32) - SIDE // 2
    grid = np.stack(np.meshgrid(offset, offset), -1).reshape(-1, 2)
    step = np.sqrt(np.abs(np.linalg.det(axes)))
    levels = np.floor(np.log2(np.maximum(1.0, step))).astype(int)
    patches = np.empty((len(positions), SIDE, SIDE), np.uint8)
    for level in range(levels.max(initial=0) + 1):
        if level:
            grey = np.asarray(cv2.pyrDown(grey), np.uint8)
        (chosen,) = np.nonzero(levels == level)
        for start in range(0, len(chosen), _AT_ONCE):
            rows = chosen[start : start + _AT_ONCE]
            # Pixel i of a reduced photo has its centre at that of pixel 2i of the larger one.
            centres = ((positions[rows] - 0.5) / 2**level).astype(np.float32)
            steps = (axes[rows] / 2**level).astype(np.float32)
            x, y = ((steps[:, k] @ grid.T + centres[:, k, None]).reshape(-1, SIDE) for k in (0, 1))
            cut = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            patches[rows] = cut.reshape(-1, SIDE, SIDE)
    return patches


def align_patches(patches: NDArray[np.uint8], pairs: NDArray[np.int32]) -> Aligned:
    """Align the second patch of each of ``pairs`` (N, 2) with the first one.

    ``pairs`` has indices of ``patches`` (M, SIDE, SIDE). A window of 15 x 15 pixels at the centre
    of the first patch is compared with the second one, with Gaussian weights.

    Raises:
        ValueError: a wrong shape or dtype, or an index that is out of range.
        UserError: the native library is missing or outdated.
    """
    check_array("patches", patches, (len(patches), SIDE, SIDE), np.uint8)
    check_array("pairs", pairs, (len(pairs), 2), np.int32)
    if pairs.size and not (pairs.min() >= 0 and pairs.max() < len(patches)):
        raise ValueError(f"pairs must be indices of {len(patches)} patches")
    aligned = Aligned(np.empty((len(pairs), 2, 3), np.float32), np.empty(len(pairs), np.float32))
    call_with_arrays(
        "align_patches",
        n=len(pairs),
        side=SIDE,
        patches=np.ascontiguousarray(patches),
        pairs=np.ascontiguousarray(pairs),
        transform=aligned.transform,
        correlation=aligned.correlation,
    )
    return aligned
