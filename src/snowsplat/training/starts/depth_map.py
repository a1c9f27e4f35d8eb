"""The type `DepthMap`, and its size."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.data.photos.image_loader import Photos
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import transform_points
from snowsplat.training.starts.photos import reduced_photo
from snowsplat.util.errors import UserError
from snowsplat.util.image_size import scaled_size

#: Photos are reduced so that their longer side has at most this number of pixels.
LONGER_SIDE = 640
#: The largest difference between the aspect ratios of a map and its photo, relative.
_ASPECT_TOLERANCE = 0.03


@dataclass(frozen=True)
class DepthMap:
    """The depths of one view; ``camera`` has the size of the map."""

    camera: Camera
    inverse_depth: Tensor  # (H, W) float32, 1 / world units; 0: unknown

    def to(self, device: torch.device) -> DepthMap:
        """This map on ``device``; its camera stays where it is."""
        return replace(self, inverse_depth=self.inverse_depth.to(device))

    def points(self, chosen: Tensor) -> Tensor:
        """(P, 3) float32: the points of the chosen pixels, (H, W) bool, in the world frame."""
        camera = self.camera
        y, x = chosen.nonzero(as_tuple=True)
        depth = 1.0 / self.inverse_depth[y, x]
        right, down = (x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy
        cam = torch.stack([right * depth, down * depth, depth], dim=1)
        return transform_points(camera.world_from_cam.to(cam), cam)


def check_aspect(file: Path, shape: tuple[int, ...], view: View) -> None:
    """Raises UserError: a map of this shape, (H, W, …), is not one of the whole photo of a view."""
    part = view.image.view
    photo = view.camera if part is None else part.lens
    height, width = shape[:2]
    if abs(width * photo.height / (height * photo.width) - 1.0) > _ASPECT_TOLERANCE:
        raise UserError(
            "{file}: has {width}x{height} pixels, but its photo has {width2}x{height2}; use a "
            "map of the whole photo",
            file=file,
            width=width,
            height=height,
            width2=photo.width,
            height2=photo.height,
        )


def photo_for_map(view: View, images: Photos, longer_side: int = LONGER_SIDE) -> LoadedImage:
    """The photo of a view at the size of its depth map, on its device."""
    size = scaled_size(view.camera.width, view.camera.height, longer_side)
    return reduced_photo(view, images, *size)
