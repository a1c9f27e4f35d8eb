"""`NeutralPhotos`: the photos of a dataset as if all had the same exposure and white balance."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.data.photos.image_loader import Photos


class NeutralPhotos:
    """Photos whose values are divided by a gain for each channel; other views are not changed."""

    def __init__(self, images: Photos, views: Sequence[View], log_gains: Tensor) -> None:
        """
        Args:
            images: loads the photos.
            log_gains: (V, 3) log of the factor by which the photo of each view is too bright. It is
                not copied, so later changes count.
        """
        self._images = images
        self._gains = {view.name: row for view, row in zip(views, log_gains, strict=True)}

    @property
    def budget_bytes(self) -> int:
        """See `ImageLoader`."""
        return self._images.budget_bytes

    @property
    def device(self) -> torch.device:
        """See `Photos`."""
        return self._images.device

    def prefetch(self, order: Iterable[View], downscale: int | None = None) -> None:
        """See `ImageLoader.prefetch`."""
        self._images.prefetch(order, downscale)

    def get(self, view: View, downscale: int | None = None) -> LoadedImage:
        """See `ImageLoader.get`. Values that become brighter than white are white."""
        image = self._images.get(view, downscale)
        gains = self._gains.get(view.name)
        if gains is None or not gains.any():
            return image
        planes = image.planes.clone()
        colors = planes[:3] * (-gains).exp().to(planes.device)[:, None, None]
        planes[:3] = colors.round().clamp(max=255.0).to(torch.uint8)
        return LoadedImage(planes, image.mask)
