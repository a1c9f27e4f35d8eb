"""Finds a background that stands still while an object turns in front of it, on a turntable.

Its matches say that the camera stands still, and they are more than those of the object. So the
background is masked: what the object never covers, and in each photo what it does not cover there.
The latter is compared with the backdrop, the grey level that most photos have in common.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_BLOCK = 16  # pixels: side of the blocks in which the edges are counted
# Of the blocks with edges, at least the first share shows edges that stand still, and at least the
# second share an object without such edges. A tripod without a turntable has no second share.
_STILL, _OBJECT = 0.3, 0.03
SAME_LEVEL = 6.0  # grey levels; compression and noise change a pixel by less
_NOISE = 3.0  # changes of less than this multiple of the noise are no changes
_PATCH = np.ones((5, 5), np.uint8)  # what has to be the same as in another photo, around a pixel
_TEXTURED = 0.3  # share of the pixels of a part of the backdrop with texture
# Share of the photos, and number of photos, that have the same patch if it belongs to the backdrop.
_SEEN, _FEWEST = 0.2, 3.0
# A block shows edges that stand still if at least the first share of its edges does, and an object
# if less than the second share does.
_STILL_EDGES, _MOVING_EDGES = 0.5, 0.1
_ELSEWHERE = 0.05  # of the largest part that moves; smaller ones are not the object


@dataclass(frozen=True)
class Backdrop:
    """A still background, in pixels of the copies; all arrays are (H, W).

    Attributes:
        never_covered: bool, where no photo shows the object.
        level: uint8, grey levels; valid where ``known``.
        known: bool, where enough photos agree on the level.
        tolerance: grey levels; larger differences are changes.
    """

    never_covered: NDArray[np.bool_]
    level: NDArray[np.uint8]
    known: NDArray[np.bool_]
    tolerance: float

    def seen_in(self, copy: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(H, W) bool: the pixels of a copy that show the background.

        A uniform part of the object may look like the backdrop. So pixels count that belong to the
        texture of the backdrop, or are connected with others that count.
        """
        same = self.known & (_difference(copy, self.level) <= self.tolerance)
        shown = (self.never_covered | same).astype(np.uint8)
        opened = cv2.morphologyEx(shown, cv2.MORPH_OPEN, _PATCH)
        _, labels = cv2.connectedComponents(opened)
        mean = np.asarray(cv2.blur(self.level, _PATCH.shape), np.uint8)
        texture = cv2.absdiff(self.level, mean) > self.tolerance / 2
        textured = np.bincount(labels[texture], minlength=labels.max() + 1)
        outside = np.union1d(
            labels[self.never_covered],
            np.flatnonzero(textured >= _TEXTURED * np.bincount(labels.ravel())),
        )
        # `_difference` compares patches, so it stops short of the silhouette by half a patch.
        connected = np.isin(labels, outside[outside > 0]).astype(np.uint8)
        return (cv2.dilate(connected, _PATCH) > 0) | self.never_covered


def find_backdrop(
    copies: NDArray[np.uint8],
    fixed: NDArray[np.bool_],
    edges: NDArray[np.int_],
    inner: tuple[slice, slice],
) -> Backdrop | None:
    """The still background; None: most of the picture moves, or nothing does.

    Args:
        copies: (N, H, W) grey copies of photos of equal size.
        fixed: (h, w) bool, the pixels between the bars with an edge at the same place in most
            photos.
        edges: (h, w), the number of photos with any edge at a pixel between the bars.
        inner: rows and columns between the bars; what is outside of them is never covered.
    """
    if not _object_before_background(fixed, edges, len(copies)):
        return None
    low, high = copies.min(axis=0).astype(np.float32), copies.max(axis=0).astype(np.float32)
    changes = high - low
    tolerance = max(SAME_LEVEL, _NOISE * float(np.median(changes[inner][fixed])))
    changed = np.zeros(changes.shape, np.uint8)
    changed[inner] = changes[inner] > tolerance
    changed = cv2.morphologyEx(changed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    changed = cv2.morphologyEx(changed, cv2.MORPH_CLOSE, np.ones((15, 15), np.uint8))
    number, labels, boxes, _ = cv2.connectedComponentsWithStats(changed)
    if number < 2:
        return None
    largest = boxes[1:, cv2.CC_STAT_AREA].max()
    for i in range(1, number):  # what moves elsewhere is not the object
        if boxes[i, cv2.CC_STAT_AREA] < _ELSEWHERE * largest:
            changed[labels == i] = 0
    level, known = _common_level(copies, tolerance)
    return Backdrop(_from_border(changed == 0), level, known, tolerance)


def _from_border(still: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The parts of ``still`` (H, W) that reach the border; the others are uniform object."""
    _, labels = cv2.connectedComponents(still.astype(np.uint8))
    border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    return np.isin(labels, np.unique(border[border > 0]))


def _object_before_background(
    fixed: NDArray[np.bool_], edges: NDArray[np.int_], count: int
) -> bool:
    height, width = (side // _BLOCK * _BLOCK for side in fixed.shape)

    def in_blocks(values: NDArray[np.int_]) -> NDArray[np.int_]:
        blocks = values[:height, :width].reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK)
        return np.asarray(blocks.sum(axis=(1, 3)))

    in_all, in_fixed = in_blocks(edges), in_blocks(np.where(fixed, edges, 0))
    textured = in_all >= count * _BLOCK
    if not textured.any():
        return False
    share = in_fixed[textured] / in_all[textured]
    return bool(
        (share >= _STILL_EDGES).mean() >= _STILL and (share < _MOVING_EDGES).mean() >= _OBJECT
    )


def _common_level(
    copies: NDArray[np.uint8], tolerance: float
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """(H, W) each: the level of the photo with whose patch most others agree, and whether it is
    the backdrop's."""
    votes = np.ones(copies.shape, np.uint8)
    for i, copy in enumerate(copies):
        for j in range(i):
            agree = _difference(copy, copies[j]) <= tolerance
            votes[i] += agree
            votes[j] += agree
    best = votes.argmax(axis=0)[None]
    level = np.take_along_axis(copies, best, axis=0)[0]
    most = np.take_along_axis(votes, best, axis=0)[0]
    return level, most >= max(_FEWEST, _SEEN * len(copies))


def _difference(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W) uint8: the largest difference of two copies in the patch around each pixel."""
    return np.asarray(cv2.dilate(cv2.absdiff(first, second), _PATCH))
