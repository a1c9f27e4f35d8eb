"""How near the renders of views are to their photos: PSNR, SSIM and, on request, LPIPS.

The image rendered is clamped to 0..1, as a screen or a file would, and is NOT rounded to 8 bits;
the photo has 8 bits as it is. (The reference's `metrics.py` reads both back from PNG files, so its
renders are rounded: that costs less than 0.01 dB at 30 dB.) Transparent photos are composed
over the background colour. Where a view has a mask, PSNR is of the pixels that count, and the
others are taken as perfect by SSIM and LPIPS.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.data.dataset import View
from snowsplat.data.image_loader import ImageLoader
from snowsplat.evaluation.lpips import Lpips
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render

# Each photo is used once: memory for so many is enough to decode ahead.
_PHOTOS_AHEAD = 6


@dataclass(frozen=True)
class ViewMetrics:
    """Figures of one view."""

    name: str
    psnr: float  # dB; infinite for the same image
    ssim: float
    lpips: float | None = None


@dataclass(frozen=True)
class Evaluation:
    """Figures of every view and their means (of the figures, as is usual, not of the errors)."""

    views: list[ViewMetrics]

    @property
    def psnr(self) -> float:
        return _mean([view.psnr for view in self.views])

    @property
    def ssim(self) -> float:
        return _mean([view.ssim for view in self.views])

    @property
    def lpips(self) -> float | None:
        values = [view.lpips for view in self.views if view.lpips is not None]
        return _mean(values) if values else None

    def as_json(self) -> dict[str, Any]:
        """For `metrics.json`: the means, and each view by name."""
        views = {view.name: asdict(view) for view in self.views}
        for figures in views.values():
            del figures["name"]
        return {"psnr": self.psnr, "ssim": self.ssim, "lpips": self.lpips, "views": views}


def _mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB, 10 log10(1 / mean squared error); images (H, W, C) in 0..1.

    ``mask`` (H, W) bool: the pixels that count. Infinite if there is no error (or no pixel).
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
    """Figures of one rendered image (H, W, 3), any range, against a photo in 0..1."""
    image = image.clamp(0.0, 1.0)
    if mask is not None:
        image = torch.where(mask[:, :, None], image, target)
    return ViewMetrics(
        name=name,
        psnr=psnr(image, target, mask),
        ssim=float(ops.ssim(image, target)),
        lpips=None if lpips is None else lpips(image, target),
    )


@torch.no_grad()
def evaluate_views(
    gaussians: Gaussians,
    views: Sequence[View],
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    lpips: Lpips | None = None,
    sh_degree: int | None = None,
    on_view: Callable[[ViewMetrics], None] | None = None,
) -> Evaluation:
    """Render each view and compare it with its photo.

    Args:
        background: colour in 0..1 behind the Gaussians and behind transparent photos.
        lpips: measure LPIPS too.
        sh_degree: render with this degree of the colours only.
        on_view: called after each view.

    Raises:
        UserError: a photo is absent or damaged.
    """
    device = gaussians.means.device
    color = torch.tensor(background, dtype=torch.float32, device=device)
    results = []
    largest = max((view.camera.width * view.camera.height for view in views), default=0)
    ahead = _PHOTOS_AHEAD * 3 * largest
    with ImageLoader(views, budget_bytes=ahead, device=device) as loader:
        loader.prefetch(views)
        for view in views:
            photo = loader.get(view)
            image = render(gaussians, view.camera, color, sh_degree).image
            results.append(compare(image, photo.over(color), photo.mask, lpips, view.name))
            if on_view is not None:
                on_view(results[-1])
    return Evaluation(results)
