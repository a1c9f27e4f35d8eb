"""Finds the image circle: a fisheye lens may show a disc, and black outside of it.

The edge of the disc does not move with the scene, so its features are false matches; and training
would put the black corners in front of every camera.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_DIRECTIONS = 180  # from the centre of the frame, in which the edge of the disc is searched
_CORNER = 0.04  # side of the corners of the frame that are compared, relative to its shorter side
#: Grey levels: stray light makes black brighter than 0.
BLACK = 40.0
# Brightness between the outside (0) and the middle of the disc (1). A pixel is lit above the first
# one. Just inside of the edge, the disc is brighter than the second one: vignetting is gradual.
_LIT, _AT_EDGE = 0.15, 0.4
# Relative to the radius: distance of the edge from the circle, and width of its blurred part.
_RESIDUAL, _BLURRED = 0.015, 0.03
_ON_CIRCLE = 0.85  # share of the directions whose edge is on the circle
_MIN_SEEN = 0.25  # share of the directions in which the edge is inside of the frame
_OFF_CENTRE = 0.15  # distance of the centres of disc and frame, relative to the shorter side
_SMALLEST = 0.6  # diameter, relative to the shorter side
_STEP = 0.5  # pixels along a direction
_AT_BORDER = 3.0  # pixels: an edge that is nearer to the border of the frame is the border's
_MARGIN = 0.015  # of the radius: the outermost part of the disc is blurred


@dataclass(frozen=True)
class ImageCircle:
    """The disc that a lens shows: its centre and its radius, in pixels of a picture."""

    x: float
    y: float
    radius: float

    def outside(self, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        """(H, W) bool: the pixels of a picture of this ``shape`` that show no scene."""
        return _distances(shape, self.x, self.y) > (1 - _MARGIN) * self.radius


def find_image_circle(copies: NDArray[np.uint8]) -> ImageCircle | None:
    """The image circle of photos (N, H, W) of equal size; None: they fill the frame."""
    height, width = copies.shape[1:]
    side = max(2, round(_CORNER * min(height, width)))
    ends = slice(None, side), slice(-side, None)
    corners = np.stack([copies[:, rows, columns] for rows in ends for columns in ends])
    if np.quantile(corners, 0.97, axis=(1, 2, 3)).max() > BLACK:  # fast for most photos
        return None
    brightest = np.quantile(copies, 0.97, axis=0)
    outside = float(np.median(np.quantile(corners, 0.97, axis=1)))
    middle = brightest[height // 4 : -height // 4, width // 4 : -width // 4]
    contrast = float(np.median(middle)) - outside
    if contrast < BLACK:
        return None
    level = (brightest - outside) / contrast
    edge = _edge(level > _LIT)
    if len(edge) < _MIN_SEEN * _DIRECTIONS:
        return None
    circle = _fit_circle(edge)
    distance = _distances(level.shape, circle.x, circle.y) / circle.radius
    off_centre = np.hypot(circle.x - width / 2, circle.y - height / 2)
    residuals = np.hypot(edge[:, 0] - circle.x, edge[:, 1] - circle.y) / circle.radius - 1
    rim = (distance > 1 - 2 * _BLURRED) & (distance < 1 - _BLURRED)
    fits = (
        2 * circle.radius >= _SMALLEST * min(height, width)
        and off_centre <= _OFF_CENTRE * min(height, width)
        and np.mean(np.abs(residuals) <= _RESIDUAL) >= _ON_CIRCLE
        and np.median(level[rim]) >= _AT_EDGE
        and np.mean(level[distance > 1 + _BLURRED] > _LIT) <= 1 - _ON_CIRCLE
    )
    return circle if fits else None


def _distances(shape: tuple[int, ...], x: float, y: float) -> NDArray[np.float64]:
    """(H, W): the distance of each pixel of a picture from a point."""
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return np.hypot(columns + 0.5 - x, rows + 0.5 - y)


def _edge(lit: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(K, 2) the outermost lit pixels, from the centre of the frame; those at its border left out.
    A direction counts only if the frame is black between this pixel and the border."""
    height, width = lit.shape
    turn = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
    steps = np.arange(0.0, np.hypot(width, height) / 2, _STEP)
    x = width / 2 + np.cos(turn)[:, None] * steps
    y = height / 2 + np.sin(turn)[:, None] * steps
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    column, row = x.astype(int).clip(0, width - 1), y.astype(int).clip(0, height - 1)
    seen = lit[row, column] & inside
    last = seen.shape[1] - 1 - seen[:, ::-1].argmax(1)
    border = inside.sum(1) - 1
    chosen = seen.any(1) & (last < border - _AT_BORDER / _STEP)
    rows = np.flatnonzero(chosen)
    return np.stack([x[rows, last[rows]], y[rows, last[rows]]], 1)


def _fit_circle(points: NDArray[np.float64]) -> ImageCircle:
    """The circle through points (K, 2): least squares, then again with the nearest 85% of them."""
    kept = points
    for _ in range(3):
        system = np.column_stack([2 * kept, np.ones(len(kept))])
        x, y, c = np.linalg.lstsq(system, (kept**2).sum(1), rcond=None)[0]
        radius = float(np.sqrt(max(c + x * x + y * y, 1e-12)))
        away = np.abs(np.hypot(points[:, 0] - x, points[:, 1] - y) - radius)
        kept = points[away <= np.quantile(away, _ON_CIRCLE)]
    return ImageCircle(float(x), float(y), radius)
