"""`LensModel`: the distortion of a lens, in the camera models of COLMAP."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LensModel:
    """The intrinsics of a distorted photo: one of COLMAP's camera models and its parameters.

    https://colmap.github.io/cameras.html lists the models and the order of their parameters.
    """

    model: str  # the name of a camera model of COLMAP, e.g. "OPENCV_FISHEYE"; or `project.BROWN`
    width: int  # pixels, of the photos that ``params`` are for
    height: int
    params: tuple[float, ...]  # focal lengths and principal point in pixels, then coefficients
