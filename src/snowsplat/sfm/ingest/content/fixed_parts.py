"""Finds what is fixed to the frame: black bars, logos, time stamps, a bonnet, a still background.

The scene moves through the frame from photo to photo, and what is fixed to the frame does not. Its
matches say that the camera stands still, and training would put it in front of every camera.

Two measures are taken for each pixel of small grey copies of the photos.

- Its range of grey levels. Bars hardly change, and their inner edge is straight and sudden: a pixel
  beside it changes with the scene. A white wall or a dark sky has no such edge.
- Its edge, the gradient of a band-pass copy. An edge that is *fixed* has the same direction and a
  similar strength in nearly all photos; one that is *slow* has so in more than half of them. The
  edges of a scene that moves little are slow around those that are fixed: a far tower, the point to
  which a street leads. Those of an overlay are fixed or move with the scene, nothing in between.

The black outside of an image circle is found first (`image_circle`).
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from snowsplat.sfm.ingest.content.image_circle import BLACK, find_image_circle
from snowsplat.sfm.ingest.content.still_background import SAME_LEVEL, Backdrop, find_backdrop
from snowsplat.util.messages import Message, message

#: Longest side in pixels of the copies.
FIXED_SIDE = 640
#: With fewer photos, an edge may be at the same place by chance.
MIN_PHOTOS = 6
#: More photos make the result no better.
ENOUGH_PHOTOS = 32

_LEAST_SIDE = 32  # pixels of a copy
# Share of the pixels of a row (or column) that are constant: in a bar at least the first, beside it
# at most the second. A bar may contain a clock, and the scene beside it may be white in places.
_BAR, _BESIDE = 0.8, 0.4
_BAR_EDGE = 4  # pixels: width of the blurred edge of a bar
_TEXT_IN_BAR = 0.003  # share of the pixels of a bar that differ by `BLACK` from the others
_SYMMETRIC = 0.02  # opposite bars that differ by less, as a fraction of the side, are equal

_FINE, _COARSE = 1.0, 3.0  # pixels: standard deviations of the band-pass filter. Shading is coarser
_EDGE = 4.0  # grey levels per pixel: gradient of an edge that can be a feature
_WEAK_EDGE = 0.75  # of `_EDGE`: a slow edge may be this weak
# The edge of a photo is that of the overlay if at least this share of the overlay's gradient is in
# it, in the same direction, and if it is not stronger than the overlay's by this factor.
_SAME_EDGE, _STRONGER = 0.25, 2.5
# Photos with an edge, divided by all photos. Before a background as bright as itself, a text has no
# edge. In few photos, edges meet at a pixel by chance.
_FIXED, _FIXED_IN_FEW, _SLOW = 0.75, 0.85, 0.5
_FEW_PHOTOS = 12
# Of the edges in and around an overlay that are slow, at least this share is fixed. Measured: 0.4
# to 0.9 for text and bonnets; at most 0.29 for 221 series of 6 to 14 photos of a moving camera.
_SUDDEN = 0.4
# The same for overlays that are not near a border, which are rare. The point to which a camera
# moves or zooms is usually in the middle. Measured for zooms without any shake: at most 0.75.
_SUDDEN_IN_MIDDLE = 0.8
_NEAR_BORDER = 0.15  # distance, as a fraction of the height or the width
_AROUND = 8  # pixels: edges at most this far from a fixed edge are around it
_GAP = 12  # pixels: gap between two words of a text
_BLUR = np.ones((9, 9), np.uint8)  # what is masked around a fixed edge: its blur is fixed, too
_TEXT_HEIGHT = 0.12  # of the height of the frame; higher overlays are no line of text
# The last digits of a clock change, so that they have no fixed edges. This number of times the
# height of a text is masked beside it.
_CHANGING_DIGITS = 1.5
# A straight edge stays where it is if the camera moves along it: a level horizon, a window sill. So
# the edges of an overlay must have more than one direction: the energy of their gradients across
# the main direction, divided by that along it. Measured: 0.00 for lines, 0.04 or more for bonnets.
_DIRECTIONS = 0.02
_ALL_OF_IT = 0.5  # share of the picture; if more does not move, it is the camera that stands still
# A part of the frame that an overlay encloses is masked, too, if its pixels change less than this
# fraction of the scene's.
_CALM = 0.5

#: Left, top, right and bottom of a part of a picture, as fractions of its width and height.
Crop = tuple[float, float, float, float]


@dataclass(frozen=True)
class FixedParts:
    """What is fixed to the frame in photos of equal size.

    Attributes:
        bars: widths of the bars at the left, top, right and bottom, in pixels of the copy.
        fixed: (H, W) bool, whether a pixel of the copy shows no scene; includes the bars.
        backdrop: the background, if it stands still and only an object in front of it moves.
        circle: the radius of the image circle (`image_circle`) in pixels of the copy; ``fixed`` is
            what is outside. None: there is none.
    """

    bars: tuple[int, int, int, int]
    fixed: NDArray[np.bool_]
    backdrop: Backdrop | None
    circle: float | None = None

    @property
    def crop(self) -> Crop | None:
        """The picture between the bars.

        None if there are no bars, or if opposite bars differ. Then it is unknown where the picture
        has its centre, on which the lens model depends: the bar may cover a part of the picture.
        """
        height, width = self.fixed.shape
        left, top, right, bottom = self.bars
        equal = abs(left - right) <= _SYMMETRIC * width and abs(top - bottom) <= _SYMMETRIC * height
        if not any(self.bars) or not equal:
            return None
        x, y = max(left, right) / width, max(top, bottom) / height
        return x, y, 1 - x, 1 - y

    @property
    def overlays(self) -> NDArray[np.bool_]:
        """(H, W) bool: what is fixed except the bars; empty pixels for a still background."""
        found = np.zeros_like(self.fixed)
        if self.backdrop is None:
            inner = _inner(self.fixed.shape, self.bars)
            found[inner] = self.fixed[inner]
        return found


def box_of(crop: Crop, width: int, height: int) -> tuple[int, int, int, int]:
    """A crop in pixels of a photo: left, top, right and bottom, at equal distances."""
    x, y = math.ceil(crop[0] * width), math.ceil(crop[1] * height)
    return x, y, width - x, height - y


def find_fixed_parts(copies: NDArray[np.uint8]) -> FixedParts | None:
    """What is fixed to the frame; None if nothing is, or if all photos show nearly the same.

    ``copies``: (N, H, W) grey copies of photos of equal size, at least `MIN_PHOTOS` of them, with
    the longest side of about `FIXED_SIDE`.
    """
    if len(copies) < MIN_PHOTOS or min(copies.shape[1:]) < _LEAST_SIDE:
        return None
    circle = find_image_circle(copies)
    if circle is not None:
        outside = circle.outside(copies.shape[1:])
        return FixedParts((0, 0, 0, 0), outside, None, circle=circle.radius)
    bars = _bars(copies)
    inner = _inner(copies.shape[1:], bars)
    fixed = np.ones(copies.shape[1:], bool)
    edges = _edges(copies[:, inner[0], inner[1]])
    backdrop = find_backdrop(copies, edges.fixed, edges.count, inner)
    if backdrop is None:
        fixed[inner] = _overlays(edges, copies[:, inner[0], inner[1]])
    else:
        fixed[inner] = backdrop.never_covered[inner]
    if not fixed.any() or fixed.all():
        return None
    return FixedParts(bars, fixed, backdrop)


def _inner(shape: tuple[int, ...], bars: tuple[int, int, int, int]) -> tuple[slice, slice]:
    """Rows and columns between the bars."""
    left, top, right, bottom = bars
    return slice(top, shape[0] - bottom), slice(left, shape[1] - right)


# Bars


def _bars(copies: NDArray[np.uint8]) -> tuple[int, int, int, int]:
    """Widths in pixels of the bars at the left, top, right and bottom, with their blurred edges."""
    low, high = np.quantile(copies, [0.03, 0.97], axis=0)
    constant = high - low <= SAME_LEVEL
    if constant.mean(axis=0).min() >= _BAR or constant.mean(axis=1).min() >= _BAR:
        return 0, 0, 0, 0  # all of it
    columns, rows = constant.mean(axis=0) < _BAR, constant.mean(axis=1) < _BAR
    left, right = int(columns.argmax()), int(columns[::-1].argmax())
    top, bottom = int(rows.argmax()), int(rows[::-1].argmax())
    middle = constant[_inner(constant.shape, (left, top, right, bottom))]

    def with_edge(width: int, beside: NDArray[np.floating]) -> int:
        """The width of a bar up to the scene; 0 if the pixels beside it change only gradually.

        ``beside``: share of constant pixels in the rows or columns next to the bar, from it on.
        """
        clear = np.flatnonzero(beside[:_BAR_EDGE] <= _BESIDE)
        return width + int(clear[0]) + 1 if width >= 2 and len(clear) else 0

    across, along = middle.mean(axis=0), middle.mean(axis=1)
    left, right = with_edge(left, across), with_edge(right, across[::-1])
    top, bottom = with_edge(top, along), with_edge(bottom, along[::-1])
    if not (left and right):
        left = left if _is_no_scene(high[:, :left], constant[:, :left]) else 0
        start = high.shape[1] - right
        right = right if _is_no_scene(high[:, start:], constant[:, start:]) else 0
    if not (top and bottom):
        top = top if _is_no_scene(high[:top], constant[:top]) else 0
        start = len(high) - bottom
        bottom = bottom if _is_no_scene(high[start:], constant[start:]) else 0
    return left, top, right, bottom


def _is_no_scene(levels: NDArray[np.floating], constant: NDArray[np.bool_]) -> bool:
    """Whether a bar without an opposite one is black, or has a text in it that does not change."""
    if not levels.size:
        return False
    middle = float(np.median(levels))
    text = constant & (np.abs(levels - middle) > BLACK)
    return middle <= BLACK or bool(text.mean() >= _TEXT_IN_BAR)


# Edges


@dataclass(frozen=True)
class _Edges:
    """The edges of the copies; all arrays are (H, W)."""

    fixed: NDArray[np.bool_]  # edges that nearly all photos have
    slow: NDArray[np.bool_]  # edges that more than half of the photos have; includes `fixed`
    count: NDArray[np.int_]  # number of photos with any edge at a pixel
    x: NDArray[np.floating]  # median gradient, in grey levels per pixel
    y: NDArray[np.floating]


def _edges(copies: NDArray[np.uint8]) -> _Edges:
    # (N, H, W) each. float16 would be faster to sort, but NumPy emulates its arithmetic.
    across = np.empty(copies.shape, np.float32)
    down = np.empty(copies.shape, np.float32)
    for i, copy in enumerate(copies):
        grey = copy.astype(np.float32)
        band = cv2.GaussianBlur(grey, (0, 0), _FINE) - cv2.GaussianBlur(grey, (0, 0), _COARSE)
        down[i], across[i] = np.gradient(band)
    # The edge of the overlay, if there is one at this pixel.
    x, y = np.median(across, axis=0), np.median(down, axis=0)
    strength = np.hypot(x, y)
    sizes = np.hypot(across, down)
    same = (across * x + down * y >= _SAME_EDGE * strength**2) & (sizes <= _STRONGER * strength)
    share = same.mean(axis=0)
    least = _FIXED if len(copies) >= _FEW_PHOTOS else _FIXED_IN_FEW
    fixed = (strength >= _EDGE) & (share >= least)
    slow = fixed | ((strength >= _WEAK_EDGE * _EDGE) & (share >= _SLOW))
    return _Edges(fixed, slow, (sizes >= _EDGE).sum(axis=0), x, y)


# Overlays


def _overlays(edges: _Edges, copies: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(H, W) bool: the pixels of texts, logos and parts of the camera."""
    found = np.zeros(edges.fixed.shape, bool)
    joined = cv2.morphologyEx(
        edges.fixed.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 2 * _GAP + 1), np.uint8)
    )
    number, labels, boxes, _ = cv2.connectedComponentsWithStats(joined)
    for i in range(1, number):
        part, (x, y, width, height) = labels == i, boxes[i, :4]
        if not _is_overlay(part, (x, y, width, height), edges):
            continue
        if height <= _TEXT_HEIGHT * len(part):
            more = round(_CHANGING_DIGITS * height)
            part[y : y + height, max(0, x - more) : x + width + more] = True
        found |= part
    if not found.any() or found.mean() > _ALL_OF_IT:
        return np.zeros_like(found)
    found = cv2.dilate(found.astype(np.uint8), _BLUR) > 0
    return _with_enclosed(found, copies)


def _is_overlay(part: NDArray[np.bool_], box: tuple[int, int, int, int], edges: _Edges) -> bool:
    """Whether a connected ``part`` (H, W) of the fixed edges is no part of the scene. ``box``:
    left, top, width and height of the part."""
    rows, columns = part.shape
    x, y, width, height = box
    gradients = np.stack([edges.x[edges.fixed & part], edges.y[edges.fixed & part]])
    across, along = np.linalg.eigvalsh(gradients @ gradients.T)
    if across < _DIRECTIONS * along:
        return False
    beside, above = min(x, columns - x - width), min(y, rows - y - height)
    at_border = beside <= _NEAR_BORDER * columns or above <= _NEAR_BORDER * rows
    around = np.ones((2 * _AROUND + 1, 2 * _AROUND + 1), np.uint8)
    near = cv2.dilate(part.astype(np.uint8), around) > 0
    sudden = _SUDDEN if at_border else _SUDDEN_IN_MIDDLE
    return bool((edges.fixed & near).sum() >= sudden * (edges.slow & near).sum())


def _with_enclosed(found: NDArray[np.bool_], copies: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Add the parts of the frame that ``found`` separates from the scene: below a bonnet's edge.
    The scene is the largest part."""
    number, labels, boxes, _ = cv2.connectedComponentsWithStats((~found).astype(np.uint8))
    if number <= 2:
        return found
    changes = copies.astype(np.float32).std(axis=0)
    scene = 1 + int(boxes[1:, cv2.CC_STAT_AREA].argmax())
    calm = _CALM * float(np.median(changes[labels == scene]))
    for i in set(range(1, number)) - {scene}:
        part = labels == i
        if float(np.median(changes[part])) <= calm:
            found = found | part
    return found


# Lines for the user


_SIDES = (message("left"), message("top"), message("right"), message("bottom"))


def describe_bars(parts: FixedParts, cropped: bool, where: Message) -> Message:
    """Where the bars are, and what was done about them; ``where``: e.g. "all 14 photos"."""
    sides = [side for side, width in zip(_SIDES, parts.bars, strict=True) if width]
    named = sides[0]
    for side in sides[1:]:
        named = message("{sides} and {side}", sides=named, side=side)
    if cropped:
        return message("bars at the {sides}: cut off in {where}", sides=named, where=where)
    return message("bars at the {sides}: masked in {where}", sides=named, where=where)


def describe(parts: FixedParts, cropped: bool, where: Message) -> list[Message]:
    """What is fixed to the frame, and what was done about it; ``where``: e.g. "all 14 photos"."""
    lines = [describe_bars(parts, cropped, where)] if any(parts.bars) else []
    if parts.circle is not None:
        lines.append(
            message(
                "the picture is a disc, as of a fisheye lens: its outside masked in {where}",
                where=where,
            )
        )
    elif parts.backdrop is not None:
        lines.append(
            message(
                "the background ({share:.0f}% of the picture) stands still while something in "
                "front of it moves, as on a turntable: masked in {where}; if nothing turns there, "
                "walk around the scene instead",
                share=100 * parts.fixed.mean(),
                where=where,
            )
        )
    elif parts.overlays.any():
        lines.append(
            message(
                "something does not move with the scene (a time stamp, a logo, a part of the "
                "camera or car): masked in {where}",
                where=where,
            )
        )
    return lines
