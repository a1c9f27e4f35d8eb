"""`confirmation`: whether other photos show what a photo shows, at the depth of the scene.

This tells a wrong pose from a part of the scene that is hard to reproduce. Fog in front of a camera
may reproduce a photo with a wrong pose; other photos do not show the same at the depth of the fog.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.data.photos.image_loader import Photos
from snowsplat.evaluation.metrics import Rendering
from snowsplat.scene.geometry import transform_points
from snowsplat.scene.surface_normals import rays_of
from snowsplat.training.starts.point_colors import point_colors

#: Side of a block of the reduced photos, in pixels.
_BLOCK = 8
#: A block has texture if its standard deviation is at least this number, in 0..1: about twice that
#: of the noise of a reduced photo.
_TEXTURE = 0.02
#: A photo with fewer blocks to compare is not judged.
_FEWEST_BLOCKS = 8
#: With fewer photos, it is not known how large the agreement is by chance.
_FEWEST_PHOTOS = 4


def confirmation(
    rendering: Rendering,
    around: Sequence[View],
    anywhere: Sequence[View],
    images: Photos,
    background: Tensor,
    downscale: int = 1,
) -> float:
    """How significantly the photos around a view confirm its pose.

    Each pixel of the photo is moved to the depth that is rendered there, and from there into the
    other photos. The agreement is the mean correlation of the brightness, in blocks of 8×8 pixels
    of the photo that have texture. Occlusion is not considered. Photos that were taken anywhere
    tell how large the agreement is by chance: in place of the photo, they are as wrong as a photo
    with a wrong pose.

    Args:
        rendering: of the view, with its depth.
        around: views around it.
        anywhere: views whose photos show something else than that of the view.
        images: loads the photos.
        background: (3,) colour in 0..1, on the device of the rendering.
        downscale: the factor by which rendering and photos are reduced.

    Returns: the agreement of the photo, minus the median of those of the photos taken anywhere, in
    standard deviations of the latter (from the median absolute deviation). NaN if fewer than 8
    blocks with texture can be compared, or with fewer than 4 photos taken anywhere.

    Raises: UserError: a photo is missing or damaged.
    """
    output, camera = rendering.output, rendering.view.camera.downscaled(downscale)
    assert output.depth is not None
    depth = output.depth / output.alpha  # NaN where there is nothing
    in_camera = (rays_of(camera, depth) * depth).flatten(1).T
    points = transform_points(camera.world_from_cam.to(depth), in_camera)
    shape = (*depth.shape, 3)
    moved = []
    for view in around:
        colors, known = point_colors(view, images, points, background, downscale)
        moved.append((_texture(colors.reshape(shape))[0], _blocks(known.reshape(shape[:2])).all(1)))

    def agreement(photo: Tensor, mask: Tensor | None) -> float:
        texture, deviation = _texture(photo)
        compared = deviation >= _TEXTURE
        if mask is not None:
            compared &= _blocks(mask).all(1)
        total, count = torch.zeros_like(deviation), torch.zeros_like(deviation)
        for there, known in moved:
            total += torch.where(known, (texture * there).mean(1), 0.0)
            count += known
        compared &= count > 0
        if int(compared.sum()) < _FEWEST_BLOCKS:
            return math.nan
        return float((total[compared] / count[compared]).mean())

    own = agreement(rendering.photo, rendering.mask)
    chance = []
    for view in anywhere:
        photo = images.get(view, downscale)
        if photo.planes.shape[1:] == depth.shape:
            chance.append(agreement(photo.over(background), photo.mask))
    values = np.array([each for each in chance if not math.isnan(each)])
    if len(values) < _FEWEST_PHOTOS:
        return math.nan
    usual = float(np.median(values))
    return (own - usual) / max(1.4826 * float(np.median(np.abs(values - usual))), 1e-3)


def _texture(image: Tensor) -> tuple[Tensor, Tensor]:
    """The brightness of an image (H, W, 3) in each block, (B, 64), with mean 0 and mean square 1,
    and its standard deviation (B,)."""
    blocks = _blocks(image.mean(-1))
    blocks = blocks - blocks.mean(1, keepdim=True)
    deviation = blocks.square().mean(1).sqrt()
    return blocks / deviation.clamp_min(_TEXTURE / 8)[:, None], deviation


def _blocks(values: Tensor) -> Tensor:
    """(B, 64): the values (H, W) in each whole block of 8×8 pixels."""
    height, width = (size // _BLOCK for size in values.shape)
    values = values[: height * _BLOCK, : width * _BLOCK]
    return values.reshape(height, _BLOCK, width, _BLOCK).transpose(1, 2).reshape(-1, _BLOCK**2)
