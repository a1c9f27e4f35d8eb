"""The colours of points of the dataset in its photos."""

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from snowsplat.data.dataset import View
from snowsplat.data.photos.image_loader import Photos
from snowsplat.scene.camera import Camera


def point_pixels(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """The pixel positions of points (P, 3) in the world frame, and which are in the image.

    Returns: (P, 2) float32, valid where the second tensor, (P,) bool, is True. Occlusion is not
    considered.
    """
    pixel, depth = camera.project(points.to(torch.float64))
    size = pixel.new_tensor([camera.width, camera.height])
    inside = (depth > 0.0) & (pixel >= 0.5).all(1) & (pixel <= size - 0.5).all(1)
    return torch.where(inside[:, None], pixel, 0.5).to(torch.float32), inside


def point_colors(
    view: View, images: Photos, points: Tensor, background: Tensor, downscale: int = 1
) -> tuple[Tensor, Tensor]:
    """The colours of the points in a photo, (P, 3) in 0..1, and which are known, (P,) bool.

    The colour is not known outside the image, at masked pixels and at transparent pixels.

    Args:
        images: loads the photo.
        points: (P, 3) in the world frame, on the device of the photo.
        background: (3,) colour in 0..1 behind transparent pixels, on the device of the photo.
        downscale: the factor by which the photo is reduced: 1, 2 or 4.

    Raises: UserError: the photo is missing or damaged.
    """
    photo = images.get(view, downscale)
    pixels, known = point_pixels(view.camera.downscaled(downscale), points)
    x, y = pixels.floor().to(torch.int64).unbind(1)
    if photo.mask is not None:
        known = known & photo.mask[y, x]
    if photo.alpha is not None:
        known = known & (photo.alpha[y, x] >= 128)
    return sampled(photo.over(background), pixels), known


def sampled(image: Tensor, pixels: Tensor) -> Tensor:
    """(P, C): the image (H, W, C) at pixel positions (P, 2), with bilinear interpolation."""
    height, width, _ = image.shape
    size = torch.tensor([width, height], device=image.device)
    grid = (2.0 * pixels / size - 1.0)[None, None]
    planes = image.permute(2, 0, 1)[None]
    return grid_sample(planes, grid, padding_mode="border", align_corners=False)[0, :, 0].T
