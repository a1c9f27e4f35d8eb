"""Reads maps that belong to photos from files: depths, as camera z, and normals."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from snowsplat.data.photos.image_file import MOST_PIXELS, TOO_LARGE, open_image, reason_of
from snowsplat.scene.camera import Camera
from snowsplat.util.errors import Problem, UserError
from snowsplat.util.safe_json import is_file

#: Suffixes of the files that `read_map` reads.
MAP_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".exr", ".pfm")

#: Takes the channels of an EXR file by name, and returns the map; a KeyError if there is none.
Pick = Callable[[Mapping[str, Any]], np.ndarray]
#: What the values of a depth map are. "z": the coordinate along the optical axis. "distance": the
#: length of the ray. "disparity": inverse depth, up to an unknown factor.
DepthKind = Literal["z", "distance", "disparity"]
#: Largest depth of a disparity map without a range, in units of the smallest depth.
FARTHEST = 20.0
# Names of the channels of EXR files, in the order of preference.
_EXR_CHANNELS = ("Z", "Y", "R", "V", "depth", "depth.Z", "Depth.Z", "RGB", "RGBA")
#: A vector whose length differs more from 1 is no normal: a background, or a blurred edge.
_LENGTH_ERROR = 0.1
#: The largest share of such pixels in a normal map; pixels of black, white and zeros do not count.
_MOST_OTHERS = 0.5


def read_map(path: Path, kind: str, pick: Pick) -> np.ndarray:
    """The values of a map, as stored, in an array of any shape and dtype.

    Args:
        path: PNG, TIFF, NPY, PFM, or EXR, which needs the package OpenEXR.
        kind: of the map, for messages, as "depth map".

    Raises:
        UserError: the file is missing, damaged or too large, or has no known suffix.
    """
    if not is_file(path):
        raise UserError("{path}: no such {kind}", path=path, kind=kind)
    suffix = path.suffix.lower()
    if suffix not in MAP_SUFFIXES:
        raise UserError(
            "{path}: unknown kind of {kind}; use {map_suffixes}",
            path=path,
            kind=kind,
            map_suffixes=", ".join(MAP_SUFFIXES),
        )
    try:
        if suffix == ".npy":
            return _read_npy(path)
        if suffix == ".exr":
            return _read_exr(path, pick)
        if suffix == ".pfm":
            return _read_pfm(path)
        with open_image(path, ("PNG", "TIFF")) as image:
            if image.mode == "P":
                raise Problem("it has a palette of colours; save the values")
            return np.asarray(image)
    except UserError:
        raise
    except Exception as error:  # each of these libraries raises many kinds of exceptions
        raise UserError(
            "{path}: cannot be read as a {kind} ({reason_of}); export it again",
            path=path,
            kind=kind,
            reason_of=reason_of(error),
        ) from None


def _read_npy(path: Path) -> np.ndarray:
    values = np.load(path, mmap_mode="r", allow_pickle=False)
    if values.size > 3 * MOST_PIXELS:
        raise Problem(TOO_LARGE)
    return np.array(values)


def _read_pfm(path: Path) -> np.ndarray:
    """PFM: the rows from the bottom to the top; a negative scale means little-endian."""
    with open(path, "rb") as file:
        kind, width, height, scale = b" ".join(file.readline(80) for _ in range(3)).split()
        shape = (int(height), int(width), {b"Pf": 1, b"PF": 3}[kind])
        if not 0 < shape[0] * shape[1] <= MOST_PIXELS:
            raise Problem(TOO_LARGE)
        values = np.fromfile(file, "<f4" if float(scale) < 0 else ">f4", math.prod(shape))
    return values.reshape(shape)[::-1]


def _read_exr(path: Path, pick: Pick) -> np.ndarray:
    try:
        import OpenEXR
    except ImportError:
        raise UserError(
            "{path}: EXR files need a package; run pip install OpenEXR, or convert it to NPY",
            path=path,
        ) from None
    with OpenEXR.File(str(path), header_only=True) as header:
        box = header.header()["dataWindow"]
        width, height = (int(high - low) + 1 for low, high in zip(*box, strict=True))
        if width * height > MOST_PIXELS:
            raise Problem(TOO_LARGE)
    with OpenEXR.File(str(path)) as file:
        channels = file.channels()
        try:
            return np.array(pick({name: channel.pixels for name, channel in channels.items()}))
        except KeyError as error:
            raise Problem(
                "no channel {args}, but {channels}",
                args=error.args[0],
                channels=", ".join(channels),
            ) from None


def read_depth_file(path: Path) -> np.ndarray:
    """The values of a depth map, as stored: (H, W) float32.

    Reads PNG files of 8 or 16 bits, TIFF files (also of 32-bit floats), NPY and PFM files, and the
    channel Z or the first grey channel of EXR files, which need the package OpenEXR.

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
        # Divided by the distances of the points with z = 1 on the rays.
        height, width = depth.shape
        scaled = camera.scaled(width, height)
        u = (torch.arange(width, dtype=torch.float64) + 0.5 - scaled.cx) / scaled.fx
        v = (torch.arange(height, dtype=torch.float64) + 0.5 - scaled.cy) / scaled.fy
        depth = depth / (1.0 + u.square() + v.square()[:, None]).sqrt()
    elif photo_z is not None:
        turned = torch.from_numpy(photo_z)
        known &= turned > 0
        depth = depth / turned
    return torch.where(known, depth, torch.nan).float()


def read_normal_file(path: Path) -> np.ndarray:
    """The normals of a map, (H, W, 3) float32 of length 1; NaN where the map has none.

    Reads PNG and TIFF files of 8 or 16 bits (of 16, the upper 8 are used), where 0 is -1 and the
    largest value 1; NPY files, (H, W, 3) or (3, H, W), of such integers or of floats in -1..1 or
    0..1; and EXR files with the channels R, G, B or X, Y, Z. The axes are those of the file.

    Raises:
        UserError: the file is missing, damaged, has no known suffix, or its values are not normals.
    """
    stored = read_map(path, "normal map", _channels)
    values = np.squeeze(stored)
    if values.ndim == 3 and values.shape[2] not in (3, 4) and values.shape[0] in (3, 4):
        values = values.transpose(1, 2, 0)
    if values.ndim != 3 or values.shape[2] not in (3, 4) or values.dtype.kind not in "fu":
        raise UserError(
            "{path}: has the shape {shape} and the type {dtype}; a normal map has three numbers "
            "per pixel",
            path=path,
            shape=stored.shape,
            dtype=stored.dtype,
        )
    values = values[..., :3]
    if values.dtype.kind == "u":
        scaled = values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)
        normals = 2.0 * scaled - 1.0
    else:
        scaled = values.astype(np.float32)
        finite = np.isfinite(scaled)
        # Normals of all directions towards a camera have negative components in any frame.
        normals = 2.0 * scaled - 1.0 if (scaled[finite] >= 0.0).all() else scaled
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.sqrt((normals * normals).sum(-1, keepdims=True))
        known = np.abs(length - 1.0) <= _LENGTH_ERROR
    marked = (scaled == 0.0).all(-1) | (scaled == 1.0).all(-1) | ~np.isfinite(length[..., 0])
    others = int((~known[..., 0] & ~marked).sum())
    if others > _MOST_OTHERS * (others + int(known.sum())):
        raise UserError(
            "{path}: its values are not normals: {size:.0f}% of the pixels have another length "
            "than 1; export x, y and z as red, green and blue",
            path=path,
            size=100 * others / known.size,
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(known, normals / length, np.float32(np.nan)).astype(np.float32)


def _channels(channels: Mapping[str, Any]) -> np.ndarray:
    """The normals among the channels of an EXR file."""
    for name in ("RGB", "RGBA"):
        if name in channels:
            return np.asarray(channels[name])
    names = "XYZ" if "X" in channels else "RGB"
    return np.stack([np.asarray(channels[name]) for name in names], -1)
