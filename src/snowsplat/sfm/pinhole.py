"""The pinhole camera that a photo gets when its lens distortion is taken out.

Sound for every calibration that SfM may come up with: no blank borders, nothing folded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pycolmap

_MAP_ERROR = 0.02  # pixels, at most
_CELLS = (64, 32, 16, 8, 4)  # pixels, about
_SMALLEST = 0.2  # of the photo's width and height; below it the calibration is no such thing


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A camera without distortion, and where its pixels are found in photos of the distorted one.

    ``nodes`` (n + 1, m + 1, 2) are positions x, y in the photo, in pixels, of the corners of n × m
    equal cells into which the new picture is divided; in between they are interpolated
    bilinearly. None where there is no distortion.
    """

    width: int  # pixels
    height: int
    params: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels
    nodes: np.ndarray | None = None
    cropped: bool = False  # shows less than it might, as the calibration is not sound further out


def pinhole_of(camera: pycolmap.Camera) -> Pinhole:
    """The pinhole camera of a distorted one: same focal lengths, no blank borders.

    Raises:
        ValueError: the distortion leaves next to nothing of the photo.
    """
    import pycolmap

    # A fisheye lens without coefficients is "undistorted" too, but no pinhole.
    if camera.is_perspective_pinhole() and camera.is_undistorted():
        params = (
            camera.focal_length_x,
            camera.focal_length_y,
            camera.principal_point_x,
            camera.principal_point_y,
        )
        return Pinhole(camera.width, camera.height, params)
    # Fills the picture from border to border, within 0.2 to 2 times the photo's size.
    whole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    made, cropped = whole, False
    if not _is_sound(camera, whole):
        # Outside of some radius a polynomial may turn back, and the picture be folded there; and a
        # picture at a bound of its size may have blank borders. Take as much around the principal
        # point as has neither.
        cropped = True
        low, high = 0.0, 1.0
        while high - low > 1e-3:
            middle = (low + high) / 2
            part = _shrunk(whole, middle)
            if part is not None and _is_sound(camera, part):
                low, made = middle, part
            else:
                high = middle
        small = made.width < _SMALLEST * camera.width or made.height < _SMALLEST * camera.height
        if low == 0 or small:
            raise ValueError("the distortion leaves next to nothing of the picture")
    fx, fy, cx, cy = (float(value) for value in made.params)
    return Pinhole(made.width, made.height, (fx, fy, cx, cy), _nodes(camera, made), cropped)


def _to_photo(
    camera: pycolmap.Camera, pinhole: pycolmap.Camera, x: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """(len(y), len(x), 2): where positions of the undistorted picture lie in the photo, pixels.

    NaN where the lens model has no answer.
    """
    fx, fy, cx, cy = pinhole.params
    across, down = np.meshgrid((x - cx) / fx, (y - cy) / fy)
    rays = np.stack([across, down, np.ones_like(across)], -1).reshape(-1, 3)
    return np.asarray(camera.img_from_cam(rays)).reshape(len(y), len(x), 2)


def _shrunk(camera: pycolmap.Camera, factor: float) -> pycolmap.Camera | None:
    """The part around the principal point, ``factor`` times as large; same focal lengths."""
    import pycolmap

    width, height = int(factor * camera.width), int(factor * camera.height)
    if width < 1 or height < 1:
        return None
    fx, fy, cx, cy = camera.params
    params = [fx, fy, cx * width / camera.width, cy * height / camera.height]
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)


def _is_sound(camera: pycolmap.Camera, pinhole: pycolmap.Camera) -> bool:
    """Whether every pixel of the picture is in the photo, and none of it is folded or torn."""
    x, y = (np.linspace(0, size, 65) for size in (pinhole.width, pinhole.height))
    source = _to_photo(camera, pinhole, x, y)
    if not np.isfinite(source).all():
        return False
    # One pixel for rounding sizes: the outermost pixels are repeated that far.
    if (source < -1).any() or (source > [camera.width + 1, camera.height + 1]).any():
        return False
    right, down = source[:-1, 1:] - source[:-1, :-1], source[1:, :-1] - source[:-1, :-1]
    area = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]
    # A hundredth of the area at the middle: what is spread so thin is not a picture any more.
    return bool(area.min() > 0.01 * area[32, 32] > 0)


def _nodes(camera: pycolmap.Camera, pinhole: pycolmap.Camera) -> np.ndarray:
    """Of the largest cells on whose inside bilinear interpolation is exact enough."""
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
