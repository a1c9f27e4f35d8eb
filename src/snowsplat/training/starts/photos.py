"""Photos at a reduced size, for the starts."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from typing import TypeVar

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from snowsplat.data.dataset import View
from snowsplat.data.photos.decode import LoadedImage
from snowsplat.data.photos.image_loader import Photos, each_photo

Item = TypeVar("Item")
Result = TypeVar("Result")


def reduced_photo(view: View, images: Photos, width: int, height: int) -> LoadedImage:
    """The photo of a view at this size, which is not larger than the photo, on its device."""
    photo = images.get(view, _reduction(view, width))
    size = (height, width)
    if photo.planes.shape[1:] == size:
        return photo
    planes = interpolate(photo.planes[None].to(torch.float32), size, mode="area")[0]
    mask = photo.mask
    if mask is not None:
        mask = interpolate(mask[None, None].to(torch.float32), size, mode="area")[0, 0] > 0.5
    return LoadedImage(planes.round().to(torch.uint8), mask)


def decoded_ahead(views: Sequence[View], widths: Sequence[int], images: Photos) -> Iterator[View]:
    """The views in their order, while the next photos are decoded for `reduced_photo`.

    ``widths``: of the reduced photos, pixels.
    """
    pairs = zip(views, widths, strict=True)
    for factor, group in groupby(pairs, lambda pair: _reduction(*pair)):
        own = [view for view, _ in group]
        images.prefetch(own, factor)
        yield from own


def _reduction(view: View, width: int) -> int:
    return next((f for f in (4, 2) if view.camera.width >= f * width), 1)


def in_threads(
    function: Callable[[Item], Result], items: Iterable[Item], device: torch.device
) -> list[Result]:
    """The results of a function of photos, in the order of the items: `each_photo`.

    Most of the time of a start is spent on one photo after another, by one thread: see
    `single_threaded`. Each result is computed by one thread, so it does not depend on their number.

    ``device``: where the function computes. A GPU is kept busy by one thread that queues its work.
    """
    if device.type == "cuda":
        return [function(item) for item in items]
    return each_photo(function, items)


def usable_pixels(photo: LoadedImage) -> Tensor | None:
    """(H, W) bool: False for masked and transparent pixels; None if all pixels are usable."""
    if photo.alpha is None:
        return photo.mask
    opaque = photo.alpha >= 128
    return opaque if photo.mask is None else photo.mask & opaque
