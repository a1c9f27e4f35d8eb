"""The pinhole camera of an undistorted photo.

It is chosen so that the undistorted image has no blank borders and no folded parts, for every
calibration that SfM may return.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pycolmap

_MAP_ERROR = 0.02  # pixels: largest error of the bilinear interpolation between nodes
_CELLS = (64, 32, 16, 8, 4)  # pixels: approximate cell sizes, tried in this order
_MIN_FRACTION = 0.2  # of width and height: if less can be undistorted, the calibration is wrong


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A camera without distortion, and the map from its pixels to those of the distorted photo.

    The undistorted image is divided into n × m equal cells. ``nodes`` (n + 1, m + 1, 2) holds the
    positions x, y in the photo, in pixels, of the corners of the cells. Positions within a cell are
    interpolated bilinearly. ``nodes`` is None if there is no distortion.
    """

    width: int  # pixels
    height: int
    params: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels
    nodes: np.ndarray | None = None
    cropped: bool = False  # whether the outer part is cut off, because the calibration is invalid


def pinhole_of(camera: pycolmap.Camera) -> Pinhole:
    """The pinhole camera for a distorted one: the same focal lengths, no blank borders.

    Raises:
        ValueError: the calibration is valid only for a small part of the photo.
    """
    import pycolmap

    # COLMAP regards a fisheye lens with zero coefficients as undistorted, but it is not a pinhole
    # camera.
    if camera.is_perspective_pinhole() and camera.is_undistorted():
        params = (
            camera.focal_length_x,
            camera.focal_length_y,
            camera.principal_point_x,
            camera.principal_point_y,
        )
        return Pinhole(camera.width, camera.height, params)
    # COLMAP chooses an image without blank borders, of 0.2 to 2 times the size of the photo.
    whole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    made, cropped = whole, False
    if not _is_valid(camera, whole):
        # Beyond some radius the distortion polynomial may decrease, so that the image is folded
        # there. If COLMAP limits the size of the image, it may have blank borders. Search for the
        # largest part around the principal point without folds and blank borders.
        cropped = True
        low, high = 0.0, 1.0
        while high - low > 1e-3:
            middle = (low + high) / 2
            part = _shrunk(whole, middle)
            if part is not None and _is_valid(camera, part):
                low, made = middle, part
            else:
                high = middle
        min_width, min_height = _MIN_FRACTION * camera.width, _MIN_FRACTION * camera.height
        if low == 0 or made.width < min_width or made.height < min_height:
            raise ValueError("less than a fifth of the width or height can be undistorted")
    fx, fy, cx, cy = (float(value) for value in made.params)
    return Pinhole(made.width, made.height, (fx, fy, cx, cy), _nodes(camera, made), cropped)


def _to_photo(
    camera: pycolmap.Camera, pinhole: pycolmap.Camera, x: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """(len(y), len(x), 2): positions of undistorted pixels in the photo, in pixels.

    NaN where the lens model is undefined.
    """
    fx, fy, cx, cy = pinhole.params
    across, down = np.meshgrid((x - cx) / fx, (y - cy) / fy)
    rays = np.stack([across, down, np.ones_like(across)], -1).reshape(-1, 3)
    return np.asarray(camera.img_from_cam(rays)).reshape(len(y), len(x), 2)


def _shrunk(camera: pycolmap.Camera, factor: float) -> pycolmap.Camera | None:
    """The part around the principal point whose size is ``factor`` times the size of the image."""
    import pycolmap

    width, height = int(factor * camera.width), int(factor * camera.height)
    if width < 1 or height < 1:
        return None
    fx, fy, cx, cy = camera.params
    params = [fx, fy, cx * width / camera.width, cy * height / camera.height]
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)


def _is_valid(camera: pycolmap.Camera, pinhole: pycolmap.Camera) -> bool:
    """Whether every pixel of the undistorted image is in the photo, without folds or gaps."""
    x, y = (np.linspace(0, size, 65) for size in (pinhole.width, pinhole.height))
    source = _to_photo(camera, pinhole, x, y)
    if not np.isfinite(source).all():
        return False
    # Because sizes are rounded, positions up to one pixel outside of the photo are allowed. There,
    # the border pixels of the photo are repeated.
    if (source < -1).any() or (source > [camera.width + 1, camera.height + 1]).any():
        return False
    right, down = source[:-1, 1:] - source[:-1, :-1], source[1:, :-1] - source[:-1, :-1]
    area = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]
    # A cell must have at least 1% of the area of the central cell: if it is stretched more, it has
    # no usable detail.
    return bool(area.min() > 0.01 * area[32, 32] > 0)


def _nodes(camera: pycolmap.Camera, pinhole: pycolmap.Camera) -> np.ndarray:
    """`Pinhole.nodes`, with the largest cells for which the error is below `_MAP_ERROR`."""
    for cell in _CELLS:
        x, y = (
            np.linspace(0, size, -(-size // cell) + 1) for size in (pinhole.width, pinhole.height)
        )
        nodes = _to_photo(camera, pinhole, x, y)
        middles = _to_photo(camera, pinhole, (x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2)
        means = (nodes[1:, 1:] + nodes[1:, :-1] + nodes[:-1, 1:] + nodes[:-1, :-1]) / 4
        if np.abs(means - middles).max() < _MAP_ERROR:
            break
    return nodes
