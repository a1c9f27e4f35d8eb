"""The training loss of one view: eq. 7 of the paper, with masks and transparent photos."""

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.data.photos.decode import LoadedImage


def view_loss(
    image: Tensor,
    photo: LoadedImage,
    background: Tensor,
    ssim_weight: float,
    huber_weight: float = 0.0,
) -> Tensor:
    """`ops.photometric_loss` of ``image`` and ``photo``: eq. 7, and ``huber_weight`` · Huber.

    A transparent photo is first composited over ``background``. At pixels where the mask is False,
    the image is replaced with the photo, so that they have no difference and no gradient.

    Args:
        image: (H, W, 3) rendering over ``background``.
        background: (3,) colour in 0..1.
    """
    target = photo.rgb if photo.alpha is None else photo.over(background)
    if photo.mask is not None:
        counts = photo.mask[:, :, None]
        image = torch.where(counts, image, target / 255 if target.dtype == torch.uint8 else target)
    return ops.photometric_loss(image, target, ssim_weight, huber_weight)
