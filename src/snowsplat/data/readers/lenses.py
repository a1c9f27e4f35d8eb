"""The lenses of other programs, in the camera models of COLMAP, or the model "BROWN".

Pixels are those of `Camera`: the centre of the first pixel is at (0.5, 0.5). Coefficients of
tangential distortion are in the order of OpenCV: x += 2 p₁ x y + p₂ (r² + 2 x²).
"""

from collections.abc import Sequence

from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.models import lens_of
from snowsplat.data.readers import parse

#: fx, fy, cx, cy in pixels.
Intrinsics = tuple[float, float, float, float]


def perspective(
    where: object,
    width: float,
    height: float,
    intrinsics: Intrinsics,
    radial: Sequence[float] = (),
    tangential: Sequence[float] = (0.0, 0.0),
    skew: float = 0.0,
) -> Lens:
    """A lens of Brown's model: x (1 + k₁ r² + k₂ r⁴ + k₃ r⁶ + k₄ r⁸), with x = X / Z.

    Args:
        where: the start of error messages.
        radial: k₁, k₂ …, at most four.
        tangential: p₁, p₂.
        skew: in pixels: how much further right a point with y = 1 is.

    Raises: UserError: the size or a focal length is not valid.
    """
    size = valid_size(where, width, height, intrinsics)
    k1, k2, k3, k4 = [*radial, 0.0, 0.0, 0.0, 0.0][:4]
    p1, p2 = tangential
    if not any((k1, k2, k3, k4, p1, p2, skew)):
        return lens_of("PINHOLE", *size, intrinsics)
    if k4 or skew:
        coefficients = (k1, k2, k3, k4, p1, p2, skew / intrinsics[0])
        return lens_of("BROWN", *size, (*intrinsics, *coefficients))
    if k3:
        return lens_of("FULL_OPENCV", *size, (*intrinsics, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    return lens_of("OPENCV", *size, (*intrinsics, k1, k2, p1, p2))


def fisheye(
    where: object,
    width: float,
    height: float,
    intrinsics: Intrinsics,
    radial: Sequence[float] = (),
    tangential: Sequence[float] = (0.0, 0.0),
) -> Lens:
    """An equidistant lens: θ (1 + k₁ θ² + k₂ θ⁴ + k₃ θ⁶ + k₄ θ⁸); arguments of `perspective`."""
    size = valid_size(where, width, height, intrinsics)
    k1, k2, k3, k4 = [*radial, 0.0, 0.0, 0.0, 0.0][:4]
    p1, p2 = tangential
    if p1 or p2:
        params = (*intrinsics, k1, k2, p1, p2, k3, k4, 0.0, 0.0)
        return lens_of("THIN_PRISM_FISHEYE", *size, params)
    return lens_of("OPENCV_FISHEYE", *size, (*intrinsics, k1, k2, k3, k4))


def equirectangular(where: object, width: float, height: float) -> Lens:
    """A panorama of the whole sphere."""
    size = parse.size_of(where, width, height)
    return lens_of("EQUIRECTANGULAR", *size, (float(size[0]), float(size[1])))


def centred_intrinsics(width: float, height: float, focal: float) -> Intrinsics:
    """One focal length, and the principal point in the middle."""
    return focal, focal, width / 2, height / 2


def valid_size(
    where: object, width: float, height: float, intrinsics: Intrinsics
) -> tuple[int, int]:
    """Width and height in pixels. Raises `UserError` if these or a focal length are not valid."""
    size = parse.size_of(where, width, height)
    fx, fy, _, _ = intrinsics
    if not (0 < fx < 1e9 and 0 < fy < 1e9):
        raise parse.damaged(where, f"the focal lengths {fx:g} and {fy:g} pixels are not valid")
    return size
