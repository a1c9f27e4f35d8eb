"""`PoseCheck`: how far the photos are shifted against the renderings of their views at the end.

If camera poses are not exact, no scene agrees with all photos. A trained scene is then a compromise
of them, and each photo is shifted against its rendering. The shift (a, b) is found by one
Gauss-Newton step of least squares,

    photo ≈ gain · image + offset + a ∂image/∂x + b ∂image/∂y

where gain and offset make it independent of the exposure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.evaluation.metrics import renderings
from snowsplat.evaluation.verdict import Reason
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import Renderer, render
from snowsplat.training.parts.part import Part, PartReport
from snowsplat.util.messages import message
from snowsplat.util.process import single_threaded

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: At most this number of views is compared, evenly chosen, to limit the time.
_VIEWS = 24
#: With fewer views, there is no result: a scene can agree with all of them, whatever the poses are.
_FEWEST_VIEWS = 8
#: After fewer steps, or fewer steps for each view, the scene still moves towards the photos. Exact
#: poses then have shifts of up to 1% of the diagonal after 20 steps, and 0.5% after 60.
_FEWEST_STEPS, _STEPS_PER_VIEW = 500, 2
#: Images are reduced to about this length of their diagonal, in pixels. Then a shift by a few
#: thousandths of the image is about a pixel, and the derivative of the image predicts it.
_DIAGONAL = 280
_FACTORS = (1, 2, 4)  # those of `ImageLoader`
#: The smallest shift after a training that shows that poses are not exact, as a share of the
#: diagonal; see docs/cameras.md.
SHIFTED = 0.0009


class PoseCheck(Part):
    """Reports at the end whether the camera poses, which do not change, are exact. No state."""

    name = "pose_check"

    def report(self, run: Run, gaussians: Gaussians) -> PartReport:
        """The line about poses that are not exact, which also counts for the verdict."""
        if run.refines_cameras:  # by a part of the user
            return PartReport()
        views = run.dataset.train
        used = [view for i, view in enumerate(views) if i not in run.excluded]
        background = run.background.evaluation.tolist()
        pixels = misalignment(gaussians, used, background, run.step)
        if pixels is None:
            return PartReport()
        line = message(
            "the photos are off by {pixels:.1f} pixels in the median: the camera poses are not "
            "exact; try --refine-poses",
            pixels=pixels,
        )
        return PartReport(lines=(line,), reasons=(Reason("usable", line),))


def misalignment(
    gaussians: Gaussians, views: Sequence[View], background: Sequence[float], steps: int
) -> float | None:
    """The median shift of the photos in pixels; None if it is small, or not due to the poses:
    there are too few views or steps.

    Args:
        gaussians: a trained scene.
        views: the views that it was trained on.
        background: RGB in 0..1.
        steps: number of steps of the training.

    Raises: UserError: a photo is missing or damaged.
    """
    if len(views) < _FEWEST_VIEWS or steps < max(_FEWEST_STEPS, _STEPS_PER_VIEW * len(views)):
        return None
    shift = shift_of(gaussians, views, background)
    return shift * _diagonal(views) if shift >= SHIFTED else None


def shift_of(
    gaussians: Gaussians,
    views: Sequence[View],
    background: Sequence[float],
    render: Renderer = render,
    sh_degree: int | None = None,
) -> float:
    """The median shift of the photos of at most 24 views, as a share of the diagonal.

    Args:
        render: renders the scene.
        sh_degree: the largest degree of the spherical harmonics to use.

    The others are those of `misalignment`.
    """
    views = views[:: math.ceil(len(views) / _VIEWS)]
    device = gaussians.means.device
    color = torch.tensor(background, dtype=torch.float32, device=device)
    diagonal = _diagonal(views)
    factor = min(_FACTORS, key=lambda factor: abs(math.log(factor * _DIAGONAL / diagonal)))
    with single_threaded(), ImageLoader(views, budget_bytes=0, device=device) as images:
        shifts = [
            float(shift_between(each.image, each.photo, each.mask).norm())
            for each in renderings(
                gaussians,
                views,
                images,
                color,
                downscale=factor,
                sh_degree=sh_degree,
                render=render,
            )
        ]
    return factor * sorted(shifts)[len(shifts) // 2] / diagonal


def _diagonal(views: Sequence[View]) -> float:
    """The median, in pixels."""
    diagonals = sorted(math.hypot(view.camera.width, view.camera.height) for view in views)
    return diagonals[len(views) // 2]


def shift_between(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> Tensor:
    """(2,) float64: the shift (x, y) in pixels that moves an image towards a photo.

    It is accurate for shifts below about one pixel, and 0 for images of one colour.

    Args:
        image, photo: (H, W, C) in 0..1, at least 3x3.
        mask: (H, W) bool, False for pixels of the photo to ignore.
    """
    grey, target = (each.double().mean(2) for each in (image, photo))
    inner = grey[1:-1, 1:-1]
    dx = 0.5 * (grey[1:-1, 2:] - grey[1:-1, :-2])
    dy = 0.5 * (grey[2:, 1:-1] - grey[:-2, 1:-1])
    columns = [dx, dy, inner, torch.ones_like(inner)]
    used = torch.ones_like(inner, dtype=torch.bool) if mask is None else mask[1:-1, 1:-1]
    a = torch.stack([column[used] for column in columns], 1)
    normal = a.T @ a + 1e-6 * torch.eye(4, dtype=a.dtype, device=a.device)
    solution = torch.linalg.solve(normal, a.T @ target[1:-1, 1:-1][used])
    # photo(p) = gain · image(p − s) + offset ≈ gain · (image(p) − s · ∂image) + offset
    return -solution[:2] / solution[2].clamp_min(1e-3)
