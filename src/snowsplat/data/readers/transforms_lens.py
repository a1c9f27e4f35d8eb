"""The lens of a frame of a transforms.json -> `Lens`.

instant-ngp and nerfstudio write the coefficients of OpenCV's models, ``k1`` … ``k6``, ``p1`` and
``p2``. In a fisheye, ``k1`` … ``k4`` are the coefficients of the angle. nerfstudio's ``k4`` of
other lenses is that of the eighth power of the radius, where OpenCV has a rational function.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from snowsplat.data.lens import models
from snowsplat.data.lens.lens import Lens
from snowsplat.data.readers.lenses import Intrinsics, equirectangular, fisheye, perspective
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import quoted

_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
#: The models that are read, by their names here.
_MODELS = {name: model for model in models.MODELS.values() for name in model.in_transforms}


def is_panorama(values: Mapping[str, Any]) -> bool:
    """Whether a frame is an equirectangular panorama, which needs no focal length."""
    flags = ("equirectangular", "is_equirectangular", "latlong")
    return _model(values) == "EQUIRECTANGULAR" or any(values.get(flag) for flag in flags)


def lens_of(
    where: str, values: Mapping[str, Any], width: int, height: int, intrinsics: Intrinsics
) -> Lens:
    """The lens of a frame.

    Args:
        where: the start of error messages.
        values: the entries of the frame and, for those that it does not have, of the file.
        width, height: of the photo that the intrinsics are for.
        intrinsics: fx, fy, cx, cy in pixels.

    Raises: UserError: the model is not known, or a coefficient is not a number.
    """
    if is_panorama(values):
        return equirectangular(where, width, height)
    model = _model(values)
    if any(key.startswith("ftheta_p") for key in values):
        model = "F-Theta"
    kind = _MODELS.get(model)
    if kind is not None and kind.equation is models.aria_fisheye:
        numbers = _distortion_params(where, values, len(kind.parameters) - len(intrinsics))
        return Lens(kind, width, height, (*intrinsics, *numbers))
    if kind is None:
        raise UserError(
            "{where}: the camera model {model} is not known; undistort the photos with the "
            "program that made the file, or make a new dataset: snowsplat sfm PHOTOS -o DATASET",
            where=where,
            model=model[:40],
        )
    if isinstance(values.get("distortion_params"), list):
        k1, k2, k3, k4, p1, p2 = _distortion_params(where, values, 6)
        k5 = k6 = 0.0
    else:
        k1, k2, k3, k4, k5, k6, p1, p2 = (
            number_of(where, values, key) or 0.0 for key in _COEFFICIENTS
        )
    radial = (k1, k2, k3, k4)
    if kind.angular or values.get("is_fisheye") or values.get("fisheye"):
        return fisheye(where, width, height, intrinsics, radial, (p1, p2))
    if k5 or k6 or (k4 and kind.name == "FULL_OPENCV"):
        numbers = (k1, k2, p1, p2, k3, k4, k5, k6)
        return models.lens_of("FULL_OPENCV", width, height, (*intrinsics, *numbers))
    return perspective(where, width, height, intrinsics, radial, (p1, p2))


def _model(values: Mapping[str, Any]) -> str:
    return str(values.get("camera_model") or "OPENCV").upper()


def number_of(where: str, values: Mapping[str, Any], key: str) -> float | None:
    """None: no number is stated. Raises UserError if the value is not a number or is damaged."""
    value = values.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:
        raise UserError(
            "{where}: {name} should be a number, not {value}; correct it",
            where=where,
            name=key,
            value=quoted(value),
        )
    return float(value)


def _distortion_params(where: str, values: Mapping[str, Any], count: int) -> tuple[float, ...]:
    listed = values.get("distortion_params")
    numbers = [*listed] if isinstance(listed, list) else []
    if len(numbers) != count:
        raise UserError(
            "{where}: distortion_params should be {count} numbers for the camera model {model}; "
            "export the file again",
            where=where,
            count=count,
            model=_model(values)[:40],
        )
    key = "distortion_params"
    return tuple(number_of(where, {key: value}, key) or 0.0 for value in numbers)
