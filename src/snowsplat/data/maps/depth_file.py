"""Reads depth maps from files, and converts their values to camera z."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from snowsplat.data.maps.map_file import read_map
from snowsplat.scene.camera import Camera
from snowsplat.util.errors import UserError

#: What the values of a depth map are. "z": the coordinate along the optical axis. "distance": the
#: length of the ray. "disparity": inverse depth, up to an unknown factor.
DepthKind = Literal["z", "distance", "disparity"]
#: Largest depth of a disparity map without a range, in units of the smallest depth.
FARTHEST = 20.0
# Names of the channels of EXR files, in the order of preference.
_EXR_CHANNELS = ("Z", "Y", "R", "V", "depth", "depth.Z", "Depth.Z", "RGB", "RGBA")


def read_depth_file(path: Path) -> np.ndarray:
    """The values of a depth map, as stored: (H, W) float32.

    Reads PNG files of 8 or 16 bits, TIFF files (also of 32-bit floats), NPY files, and the channel
    Z or the first grey channel of EXR files, which need the package OpenEXR.

    Raises:
        UserError: the file is missing, damaged, not a map of one channel, or has no known suffix.
    """
    values = np.squeeze(read_map(path, "depth map", _channel))
    if values.ndim == 3 and values.shape[2] in (3, 4):
        grey = (values[..., :1] == values[..., :3]).all()
        values = values[..., 0] if grey else values
    if values.ndim != 2 or values.dtype.kind not in "fiub":
        raise UserError(
            "{path}: has the shape {shape} and the type {dtype}; a depth map has one number per "
            "pixel",
            path=path,
            shape=values.shape,
            dtype=values.dtype,
        )
    return np.ascontiguousarray(values, np.float32)


def _channel(channels: Mapping[str, Any]) -> np.ndarray:
    """The depth among the channels of an EXR file."""
    for name in _EXR_CHANNELS:
        if name in channels:
            return np.asarray(channels[name])
    raise KeyError(_EXR_CHANNELS[0])


def to_z(
    values: np.ndarray,
    kind: DepthKind,
    camera: Camera,
    near: float | None = None,
    far: float | None = None,
    photo_z: np.ndarray | None = None,
) -> Tensor:
    """Camera z (H, W) float32 in world units; NaN where it is unknown.

    Values that are not finite, and values of z and distance that are not positive, are unknown. A
    disparity of 0 or less is infinitely far.

    Args:
        values: (H, W), as stored.
        camera: of any size; it defines the rays of a map of distances.
        near: depth of the nearest pixel. With ``far``, the values are mapped linearly, so that they
            cover this range: a distance or z itself, or 1 / z of a disparity. Without both, a
            distance or z is in world units, and z = max(disparity) / disparity, but at most
            `FARTHEST`.
        far: depth of the farthest pixel.
        photo_z: (H, W); the values are of a photo whose optical axis has another direction, and
            this is z in the frame of the photo of the points at z = 1 of the camera.

    Raises: UserError: no value is known, or only one of ``near`` and ``far`` is given, or they are
    not 0 < near < far.
    """
    if (near is None) != (far is None):
        raise UserError("`near` and `far` are the two ends of a range; set both of them")
    if near is not None and far is not None and not 0.0 < near < far < np.inf:
        raise UserError(
            "`near` {near:g} and `far` {far:g} are no range; use 0 < near < far", near=near, far=far
        )
    depth = torch.from_numpy(np.asarray(values, np.float32)).double()
    known = depth.isfinite()
    if near is None and kind != "disparity":
        known &= depth > 0
    if not bool(known.any()):
        raise UserError("the depth map has no valid value; all are 0, negative, infinite or NaN")
    low, high = float(depth[known].min()), float(depth[known].max())
    if near is not None and far is not None:
        first, last = (1.0 / far, 1.0 / near) if kind == "disparity" else (near, far)
        share = (depth - low) / (high - low) if high > low else torch.ones_like(depth)
        depth = first + share * (last - first)
    elif kind == "disparity":
        if high <= 0.0:
            raise UserError("the depth map has no positive disparity; set `depth_is` to z")
        depth = (depth / high).clamp_min(1.0 / FARTHEST)
    if kind == "disparity":
        depth = 1.0 / depth
    elif kind == "distance":
        depth = depth / _ray_lengths(depth.shape[1], depth.shape[0], camera)
    elif photo_z is not None:
        turned = torch.from_numpy(photo_z)
        known &= turned > 0
        depth = depth / turned
    return torch.where(known, depth, torch.nan).float()


def _ray_lengths(width: int, height: int, camera: Camera) -> Tensor:
    """(H, W): the distance of the points with z = 1 on the rays of a ``width`` × ``height`` map."""
    scaled = camera.scaled(width, height)
    u = (torch.arange(width, dtype=torch.float64) + 0.5 - scaled.cx) / scaled.fx
    v = (torch.arange(height, dtype=torch.float64) + 0.5 - scaled.cy) / scaled.fy
    return (1.0 + u.square() + v.square()[:, None]).sqrt()
