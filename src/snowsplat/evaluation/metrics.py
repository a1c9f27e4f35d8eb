"""Comparing rendered views with their photos: PSNR, SSIM and, on request, LPIPS.

The rendered image is clamped to 0..1, as for a screen or a file, but it is not rounded to 8 bits.
(The script `metrics.py` of the reference implementation reads rendered images from PNG files, where
they are rounded. At 30 dB this costs less than 0.01 dB.) Transparent photos are composited over
the background colour. If a view has a mask, the masked pixels are ignored. For SSIM and LPIPS, they
are equal in both images, and what differs is divided by the area of the other pixels: otherwise, a
photo that is mostly masked would have an SSIM near 1, whatever the image is.

The colour-aligned PSNR is measured after a gain and an offset of each channel of the image were
fitted to the photo, see `color_fit`. Thus it does not count that the photo has another
exposure or white balance than the scene. It is listed beside the PSNR and never replaces it.

`renderings` yields the views of a scene beside their photos, at any of the sizes of `ImageLoader`.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from snowsplat import ops
from snowsplat.data.dataset import View
from snowsplat.data.files.photo_files import warn_of_unusable
from snowsplat.data.photos.image_loader import ImageLoader, Photos
from snowsplat.evaluation.lpips import Lpips
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import Renderer, RenderOutput, render
from snowsplat.util.errors import UserError
from snowsplat.util.messages import Message, message
from snowsplat.util.names import first_names

# Number of photos for which there is memory. Each photo is used once, so the memory only serves to
# decode ahead.
_PHOTOS_AHEAD = 6
# Pixels: the longest side of the copies whose contours are compared, and the side of the square
# around a pixel with which it is compared. It is 3% of the photo: a camera that is a degree off
# moves contours by half of that.
_CONTOUR_SIDE, _AROUND = 256, 7


@dataclass(frozen=True)
class ViewMetrics:
    """The metrics of one view."""

    name: str
    psnr: float  # dB; infinite for equal images
    ssim: float
    psnr_aligned: float  # dB; colour-aligned
    lpips: float | None = None
    # Share of the variance of the photo that the colour-aligned image explains, at most 1. Unlike a
    # PSNR, it does not depend on the contrast of the photo. None: not measured.
    explained: float | None = None
    # The same share of the contours: of what differs from its surroundings in a copy of the photo
    # with a longest side of 256 pixels. None: not measured.
    contours: float | None = None
    # Width and height of the compared images, in pixels; None: unknown.
    size: tuple[int, int] | None = None


@dataclass(frozen=True)
class Evaluation:
    """The metrics of all views and their means.

    As usual, the mean PSNR is the mean of the PSNR values, not the PSNR of the mean error. Means of
    no views are NaN.

    Attributes:
        views: those whose photos can be judged.
        unjudged: the names of the others; see `is_plain`.
    """

    views: list[ViewMetrics]
    unjudged: tuple[str, ...] = ()

    @property
    def psnr(self) -> float:
        """Mean PSNR in dB."""
        return _mean([view.psnr for view in self.views])

    @property
    def ssim(self) -> float:
        """Mean SSIM."""
        return _mean([view.ssim for view in self.views])

    @property
    def psnr_aligned(self) -> float:
        """Mean colour-aligned PSNR in dB."""
        return _mean([view.psnr_aligned for view in self.views])

    @property
    def lpips(self) -> float | None:
        """Mean LPIPS; None if it was not measured."""
        values = [view.lpips for view in self.views if view.lpips is not None]
        return _mean(values) if values else None

    @property
    def size(self) -> str:
        """The size of the compared images as text: "800x600", or the range of the sizes."""
        return size_text(view.size for view in self.views if view.size is not None)

    def as_json(self) -> dict[str, Any]:
        """The content of `metrics.json`: the means, and the metrics of each view by name."""
        views = {view.name: asdict(view) for view in self.views}
        for metrics in views.values():
            del metrics["name"]
        means = {
            "psnr": self.psnr,
            "ssim": self.ssim,
            "psnr_aligned": self.psnr_aligned,
            "lpips": self.lpips,
            "size": self.size,
            "unjudged": self.unjudged,
        }
        return {**means, "views": views}

    def line_of_unjudged(self) -> Message:
        """The photos that do not count, and why; empty if there are none."""
        if not self.unjudged:
            return Message("")
        return message(
            "not judged, because they show one colour, are wholly masked or damaged: {names}",
            names=first_names(self.unjudged, 3),
        )


def size_text(sizes: Iterable[tuple[int, int]]) -> str:
    """The width and height of images as text; of several sizes, the smallest and the largest."""
    ordered = sorted(sizes, key=math.prod)
    if not ordered:
        return "an unknown size"
    ends = (ordered[0], ordered[-1])
    return " to ".join(dict.fromkeys(f"{width}x{height}" for width, height in ends))


def _mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def is_plain(photo: Tensor, mask: Tensor | None = None) -> bool:
    """Whether a photo (H, W, 3) in 0..1 cannot judge an image: a single colour reproduces it.

    Its RMS difference from its mean colour is less than one of 255 levels, which is the noise of
    rounding and of JPEG; or ``mask`` (H, W) leaves no pixel. Its colour-aligned PSNR is infinite,
    or at least 48 dB, whatever the image is.
    """
    pixels = (photo.flatten(0, 1) if mask is None else photo[mask]).to(torch.float64)
    return not len(pixels) or float((pixels - pixels.mean(0)).square().mean()) < 255.0**-2


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB: 10 log10(1 / mean squared error).

    It is infinite if there is no error or no pixel.

    Args:
        image: (H, W, C) in 0..1.
        target: (H, W, C) in 0..1.
        mask: (H, W) bool, False for pixels to ignore.
    """
    error = (image.to(torch.float64) - target.to(torch.float64)).square()
    if mask is not None:
        error = error[mask]
    total = float(error.sum())
    return 10.0 * math.log10(error.numel() / total) if total > 0.0 else math.inf


@torch.no_grad()
def compare(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    lpips: Lpips | None = None,
    name: str = "",
) -> ViewMetrics:
    """The metrics of one rendered image.

    Args:
        image: (H, W, 3), any range; it is clamped to 0..1.
        target: the photo, (H, W, 3) in 0..1.
        mask: (H, W) bool, False for pixels to ignore.
        lpips: measures LPIPS too, unless None.
        name: the name of the view.
    """
    image = image.clamp(0.0, 1.0)
    aligned = color_aligned(image, target, mask)
    if mask is not None:
        image = torch.where(mask[:, :, None], image, target)
    ssim = float(ops.ssim(image, target))
    distance = None if lpips is None else lpips(image, target)
    if mask is not None:
        parts = mask.numel() / max(1, int(mask.sum()))  # areas of the size of the unmasked one
        ssim = 1.0 - parts * (1.0 - ssim)
        distance = None if distance is None else parts * distance
    return ViewMetrics(
        name=name,
        psnr=psnr(image, target, mask),
        ssim=ssim,
        psnr_aligned=psnr(aligned, target, mask),
        lpips=distance,
        size=(image.shape[1], image.shape[0]),
        explained=_explained(aligned, target, mask),
        contours=_contours(aligned, target, mask),
    )


def _explained(image: Tensor, target: Tensor, mask: Tensor | None) -> float:
    """`ViewMetrics.explained`; 0 for a photo of one colour."""
    x, y = (each.to(torch.float64) for each in (image, target))
    x, y = (x.flatten(0, 1), y.flatten(0, 1)) if mask is None else (x[mask], y[mask])
    variance = float((y - y.mean(0)).square().sum()) if len(y) else 0.0
    return 1.0 - float((x - y).square().sum()) / variance if variance > 0.0 else 0.0


def _contours(image: Tensor, target: Tensor, mask: Tensor | None) -> float:
    """`ViewMetrics.contours`; 0 for a photo without any."""
    used = torch.ones_like(target[:, :, :1]) if mask is None else mask[:, :, None].to(target.dtype)
    # Masked pixels are those of the photo in both images, and do not count.
    image = torch.where(used > 0.0, image, target)
    stacked = torch.cat([image, target, used], dim=2).permute(2, 0, 1)[None]
    factor = _CONTOUR_SIDE / max(stacked.shape[-2:])
    if factor < 1.0:
        size = [max(1, round(side * factor)) for side in stacked.shape[-2:]]
        stacked = interpolate(stacked, size, mode="area")
    around = avg_pool2d(stacked, _AROUND, 1, _AROUND // 2, count_include_pad=False)
    x, y, _ = ((stacked - around)[0].to(torch.float64)).split([3, 3, 1])
    weight = stacked[0, 6:].to(torch.float64)
    total = float((weight * y.square()).sum())
    return 1.0 - float((weight * (x - y).square()).sum()) / total if total > 0.0 else 0.0


@torch.no_grad()
def evaluate_views(
    gaussians: Gaussians,
    views: Sequence[View],
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    lpips: Lpips | None = None,
    sh_degree: int | None = None,
    on_view: Callable[[ViewMetrics], None] | None = None,
    render: Renderer = render,
) -> Evaluation:
    """Render each view and compare it with its photo.

    Args:
        gaussians: the scene.
        views: the views, in the order of the result.
        background: RGB in 0..1 behind the Gaussians and behind transparent photos.
        lpips: measures LPIPS too, unless None.
        sh_degree: the largest SH degree to render; None uses all.
        on_view: called after each view.
        render: renders the scene.

    Returns: the metrics of the photos that can be judged, see `is_plain`, and the other names.

    Raises:
        UserError: at least half of the photos cannot be decoded.
    """
    device = gaussians.means.device
    color = torch.tensor(background, dtype=torch.float32, device=device)
    results, unjudged = [], []
    largest = max((view.camera.width * view.camera.height for view in views), default=0)
    ahead = _PHOTOS_AHEAD * 3 * largest
    with ImageLoader(views, budget_bytes=ahead, device=device) as loader:
        draw = partial(renderings, sh_degree=sh_degree, render=render, leave_out=True)
        for each in draw(gaussians, views, loader, color):
            if is_plain(each.photo, each.mask):
                unjudged.append(each.view.name)
                continue
            results.append(compare(each.image, each.photo, each.mask, lpips, each.view.name))
            if on_view is not None:
                on_view(results[-1])
    known = {*unjudged, *(each.name for each in results)}
    unjudged += [view.name for view in views if view.name not in known]
    return Evaluation(results, tuple(unjudged))


def color_fit(
    image: Tensor, photo: Tensor, mask: Tensor | None = None
) -> tuple[Tensor, Tensor] | None:
    """The gain and the offset of each channel with which an image is most similar to a photo.

    They minimise Σ (gain · image + offset − photo)² over the pixels of the images (H, W, 3) where
    ``mask`` (H, W) is True. A negative gain would invert the image, so it is at least 0.

    Returns gain (3,) and offset (3,), float64; None if the mask leaves no pixel.
    """
    if mask is None:
        x, y = image.flatten(0, 1).double(), photo.flatten(0, 1).double()
    else:
        x, y = image[mask].double(), photo[mask].double()
    if not len(y):
        return None
    mean_x, mean_y = x.mean(0), y.mean(0)
    x, y = x - mean_x, y - mean_y
    gain = (x * y).sum(0) / x.square().sum(0).clamp_min(1e-12)
    gain = gain.clamp_min(0.0)
    return gain, mean_y - gain * mean_x


def color_aligned(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> Tensor:
    """The image (H, W, 3) with the gain and offset of `color_fit`, clamped to 0..1."""
    fit = color_fit(image, photo, mask)
    if fit is None:
        return image
    gain, offset = fit
    return (gain * image.double() + offset).clamp(0.0, 1.0).to(torch.float32)


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
    leave_out: bool = False,
) -> Iterator[Rendering]:
    """Render the views one after the other, while the next photos are decoded.

    Args:
        photos: loads the photos of the views.
        background: (3,) in 0..1, behind the scene and behind transparent photos.
        downscale: the factor by which renderings and photos are reduced: 1, 2 or 4.
        sh_degree: the largest SH degree to render; None uses all.
        render: renders the scene.
        leave_out: views whose photos cannot be decoded are left out, and named in a warning.

    Raises: UserError: a photo is missing or damaged, or with ``leave_out`` at least half of them.
    """
    photos.prefetch(views, downscale)
    errors: dict[str, UserError] = {}
    for view in views:
        try:
            photo = photos.get(view, downscale)
        except UserError as error:
            if not leave_out:
                raise
            errors[view.name] = error
            continue
        camera = view.camera.downscaled(downscale).to(gaussians.means.device)
        output = render(gaussians, camera, background, sh_degree)
        image = output.image.clamp(0.0, 1.0)
        yield Rendering(view, image, photo.over(background), photo.mask, output)
    if errors:
        warn_of_unusable(views[0].image.path.parent, errors, len(views) - len(errors))
