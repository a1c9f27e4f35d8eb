"""`renderings`: views of a scene beside their photos, at any of the sizes of `ImageLoader`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.data.photos.image_loader import Photos
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import Renderer, RenderOutput, render


@dataclass(frozen=True)
class Rendering:
    """A view of a scene, on the device of its Gaussians.

    Attributes:
        view: of the scene, at its full size.
        image: (H, W, 3) in 0..1, clamped as for a screen.
        photo: (H, W, 3) in 0..1, over the background of the image.
        mask: (H, W) bool, False for pixels to ignore; None: all count.
        output: the rendering, not clamped.
    """

    view: View
    image: Tensor
    photo: Tensor
    mask: Tensor | None
    output: RenderOutput


@torch.no_grad()
def renderings(
    gaussians: Gaussians,
    views: Sequence[View],
    photos: Photos,
    background: Tensor,
    *,
    downscale: int = 1,
    sh_degree: int | None = None,
    render: Renderer = render,
) -> Iterator[Rendering]:
    """Render the views one after the other, while the next photos are decoded.

    Args:
        photos: loads the photos of the views.
        background: (3,) in 0..1, behind the scene and behind transparent photos.
        downscale: the factor by which renderings and photos are reduced: 1, 2 or 4.
        sh_degree: the largest SH degree to render; None uses all.
        render: renders the scene.

    Raises: UserError: a photo is missing or damaged.
    """
    photos.prefetch(views, downscale)
    for view in views:
        photo = photos.get(view, downscale)
        camera = view.camera.downscaled(downscale).to(gaussians.means.device)
        output = render(gaussians, camera, background, sh_degree)
        image = output.image.clamp(0.0, 1.0)
        yield Rendering(view, image, photo.over(background), photo.mask, output)
