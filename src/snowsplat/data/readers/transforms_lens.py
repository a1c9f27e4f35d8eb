"""The lens of a frame of a transforms.json -> `Lens`.

instant-ngp and nerfstudio write the coefficients of OpenCV's models, ``k1`` … ``k6``, ``p1`` and
``p2``. In a fisheye, ``k1`` … ``k4`` are the coefficients of the angle. nerfstudio's ``k4`` of
other lenses is that of the eighth power of the radius, where OpenCV has a rational function.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from snowsplat.data.lens import models
from snowsplat.data.lens.lens import Lens, Model
from snowsplat.data.photos.decode import read_header
from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import equirectangular, fisheye, perspective, valid_size
from snowsplat.util.errors import UserError

_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
#: The models that are read, by their names here.
_MODELS = {name: model for model in models.MODELS.values() for name in model.in_transforms}
_PANORAMA = ("equirectangular", "is_equirectangular", "latlong")


def lens_of(where: str, values: Mapping[str, Any], image: Path) -> Lens:
    """The lens of a frame.

    Args:
        where: the start of error messages.
        values: the entries of the frame and, for those that it does not have, of the file.
        image: the image file, which provides the size if ``values`` has none.

    Raises: UserError: the model or the focal length is not known, or a value is not plausible.
    """
    if values.get("fl_x") is None and values.get("K") is not None:
        k = parse.numbers(f"{where}: K", values["K"], 3, 3)
        values = {**values, "fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
    width, height = stated(where, values, "w"), stated(where, values, "h")
    if width is None or height is None:
        header = read_header(image)
        width, height = header.width, header.height
    width, height = round(width), round(height)
    model = str(values.get("camera_model") or "OPENCV").upper()
    if model == "EQUIRECTANGULAR" or any(values.get(flag) for flag in _PANORAMA):
        return equirectangular(where, width, height)
    fx, fy = _focal(where, values, "x", width), _focal(where, values, "y", height)
    # Pixels are square if there is only one focal length.
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None or fy is None:
        raise parse.damaged(where, "no focal length (fl_x or camera_angle_x)")
    cx, cy = stated(where, values, "cx"), stated(where, values, "cy")
    intrinsics = fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy
    valid_size(where, width, height, intrinsics)
    if any(key.startswith("ftheta_p") for key in values):
        model = "F-Theta"
    kind = _MODELS.get(model)
    if kind is None:
        raise UserError(
            "{where}: the camera model {model} is not known; undistort the photos with the "
            "program that made the file, or make a new dataset: snowsplat sfm PHOTOS -o DATASET",
            where=where,
            model=model[:40],
        )
    listed = values.get("distortion_params")
    if kind.equation not in (models.opencv, models.fisheye):
        return Lens(kind, width, height, (*intrinsics, *_coefficients(where, values, kind)))
    if isinstance(listed, list):
        k1, k2, k3, k4, p1, p2 = parse.numbers(f"{where}: distortion_params", listed, 6).tolist()
        k5 = k6 = 0.0
    else:
        k1, k2, k3, k4, k5, k6, p1, p2 = (
            stated(where, values, key) or 0.0 for key in _COEFFICIENTS
        )
    radial = (k1, k2, k3, k4)
    if kind.angular or values.get("is_fisheye") or values.get("fisheye"):
        return fisheye(where, width, height, intrinsics, radial, (p1, p2))
    if k5 or k6 or (k4 and kind.name == "FULL_OPENCV"):
        params = (*intrinsics, k1, k2, p1, p2, k3, k4, k5, k6)
        return models.lens_of("FULL_OPENCV", width, height, params)
    return perspective(where, width, height, intrinsics, radial, (p1, p2))


def _coefficients(where: str, values: Mapping[str, Any], kind: Model) -> list[float]:
    """The coefficients of a model: all in one list, or by their names in the table of models; those
    that are not stated are 0. Raises UserError: none is stated."""
    names = kind.parameters[kind.parameters.index("cy") + 1 :]
    by_name = [stated(where, values, name) for name in names]
    listed = values.get("distortion_params")
    if isinstance(listed, list) or all(value is None for value in by_name):
        return [*parse.numbers(f"{where}: distortion_params", listed, len(names)).tolist()]
    return [value or 0.0 for value in by_name]


def stated(where: str, values: Mapping[str, Any], key: str) -> float | None:
    """The number ``values[key]``; None: none is stated. Raises UserError: not a number."""
    return None if values.get(key) is None else parse.number(where, values, key)


def _focal(where: str, values: Mapping[str, Any], axis: str, size: int) -> float | None:
    """Focal length in pixels along an axis ("x" or "y"), or None. It is read from ``fl_x``,
    ``camera_angle_x`` (radians) or ``x_fov`` (degrees)."""
    pixels, angle, degrees = (
        stated(where, values, key) for key in (f"fl_{axis}", f"camera_angle_{axis}", f"{axis}_fov")
    )
    if angle is None and degrees is not None:
        angle = math.radians(degrees)
    if angle is None or pixels is not None:
        return pixels
    if not 0 < angle < math.pi:
        raise parse.damaged(where, f"the field of view {math.degrees(angle):g}° is not valid")
    return 0.5 * size / math.tan(0.5 * angle)
