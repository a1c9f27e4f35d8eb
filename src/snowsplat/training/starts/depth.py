"""`depth_points`: points on the surfaces, from the depth maps of the dataset."""

import logging
import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.lens.resample import nearest
from snowsplat.data.maps.depth_alignment import align
from snowsplat.data.maps.map_files import DepthKind, read_depth_file, to_z
from snowsplat.data.photos.image_loader import Photos
from snowsplat.scene.camera import Camera
from snowsplat.training.starts.depth_map import LONGER_SIDE, DepthMap, check_aspect, photo_for_map
from snowsplat.training.starts.fusion import fused_points
from snowsplat.training.starts.photos import usable_pixels
from snowsplat.training.starts.source_views import choose_views
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.image_size import scaled_size

logger = logging.getLogger(__name__)

#: A map is used if the median error of its disparities is at most the first share of the disparity,
#: or the second share of the error of a map of one depth.
_SMALL_ERROR, _LARGEST_ERROR = 0.02, 0.5
_KINDS: tuple[DepthKind, ...] = ("z", "distance", "disparity")


def depth_points(
    dataset: Dataset, images: Photos, count: int, generator: torch.Generator
) -> Points:
    """At most ``count`` points on the surfaces of the depth maps, in the world frame, on the CPU.

    The maps may have any unit. Each of them is aligned to the points of the dataset that its photo
    shows: as z and as distance up to a factor, and as disparity up to a factor and a shift (Ranftl
    et al. 2022). The kind with the smallest error is used. If the dataset has no points, the values
    must be z in units of ``View.depth_unit``. Pixels are used whose depth the map of another view
    confirms.

    Args:
        generator: a random generator on the CPU.

    Raises:
        SettingError: the dataset has no depth maps.
        UserError: a depth map is damaged, or not one of its photo; no map agrees with the points.
    """
    if not any(view.depth for view in dataset.train):
        raise SettingError(
            "init",
            "depth needs depth maps, and the dataset has none; add them as depths/IMG.png for the "
            "photo IMG.jpg (PNG, TIFF, NPY or EXR), or choose another start",
        )
    chosen = choose_views(dataset, images, generator)
    points = None if dataset.points is None else chosen.points
    maps = [aligned_depth_map(view, images, points) for view in chosen.views]
    unused = sum(view.depth is not None for view in chosen.views) - sum(map(bool, maps))
    if not any(maps):
        raise UserError(
            "{description}: no depth map agrees with the points; check that the maps belong to "
            "these photos, or choose another start than depth with `init`",
            description=dataset.description,
        )
    if unused:
        logger.warning("%d depth maps do not agree with the points; not used", unused)
    there = [found and found.to(images.device) for found in maps]
    return fused_points(chosen, there, images, count, generator)


def aligned_depth_map(
    view: View, images: Photos, points: Tensor | None, longer_side: int = LONGER_SIDE
) -> DepthMap | None:
    """The map of a view in world units, on the CPU; None without a map, or if it contradicts the
    points.

    See `depth_points`.

    Args:
        points: (P, 3) in the world frame; None: the values are z, in units of ``View.depth_unit``.
        longer_side: the maximum size of the result, in pixels.

    Raises: UserError: the map is damaged, or not one of its photo.
    """
    if view.depth is None:
        return None
    values = view.depth_unit * read_depth_file(view.depth)
    if view.depth_confidence is not None:
        confidence = read_depth_file(view.depth_confidence)
        if confidence.shape == values.shape:
            values[confidence == 0] = np.nan
        if not (values > 0).any():  # too dark, or too far away for the sensor
            return None
    check_aspect(view.depth, values.shape, view)
    camera, part = view.camera, view.image.view
    width, height = scaled_size(camera.width, camera.height, longer_side)
    camera = camera.scaled(width, height)
    if part is None:
        whole = torch.from_numpy(values)[None, None]
        small = interpolate(whole, (height, width), mode="nearest-exact")[0, 0].numpy()
        z = _world_z(small, camera, points, None)
    else:
        small = nearest(values, part, width, height)
        z = _world_z(small, camera, points, part.photo_z(width, height))
    if z is None:
        return None
    known = z.isfinite()
    usable = usable_pixels(photo_for_map(view, images, longer_side))
    if usable is not None:
        known &= usable.cpu()
    return DepthMap(camera, torch.where(known, 1.0 / z, 0.0))


def _world_z(
    values: np.ndarray, camera: Camera, points: Tensor | None, photo_z: np.ndarray | None
) -> Tensor | None:
    """(H, W): the kind of values and the scale with which they agree best with the points."""
    if photo_z is not None and not np.isfinite(values).any():  # the photo has depths elsewhere
        return None
    if points is None:
        return to_z(values, "z", camera, photo_z=photo_z)
    best, least = None, math.inf
    for kind in _KINDS:
        try:
            z = to_z(values, kind, camera, photo_z=photo_z)
            alignment = align(z, points, camera, with_shift=kind == "disparity")
        except UserError:  # not this kind, or the photo shows too few points
            continue
        usable = not contradicts(alignment.error, alignment.spread)
        if usable and alignment.error < least:
            best, least = alignment.apply(z), alignment.error
    return best


def contradicts(error: float, spread: float) -> bool:
    """Whether the errors of a depth map are so large that it is a map of something else.

    Args:
        error: the median error of its inverse depths, relative to their median.
        spread: that of a map of one depth.
    """
    return error > max(_SMALL_ERROR, _LARGEST_ERROR * spread)
