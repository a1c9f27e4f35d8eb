"""Overfitting, told without held-out photos: the scene becomes worse at views nobody photographed.

With few photos, a long training run improves the photos and spoils the views around them. The loss
does not tell: it decreases. The variance of the image when Gaussians are left out at random does
not tell either: it increases in every training run.

Here, the colours of points are compared at *unseen views*. A point of the dataset that has the same
colour in two photos should have this colour from every direction near them. An unseen view lies
beside a photo, on the side opposite to a second photo that shows the same points. The points and
their colours do not depend on the scene, so the estimates of a training run can be compared:

    estimate = −10 log₁₀ mean_vp min(‖I_v(u_vp) − c_p‖² / 3, 0.2²)   in dB,

where I_v is the rendering of the unseen view v, u_vp the pixel of the point p in it, and c_p the
mean of the colours of p in the two photos. Some points are hidden in the unseen view. Because
errors are limited to 0.2, these points lower the estimate by about the same amount each time.

The estimate is computed at regular moments, if there is at least one epoch between two of them:
otherwise, the photos are not repeated often enough to overfit. The rule is early stopping with
patience (Prechelt, "Early Stopping – But When?", 1998): the scene overfits if several estimates in
a row are below the best one. The rest of the schedule is then completed in a quarter of its steps,
so that the learning rates still decrease to their final values.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.data.image_loader import Photos
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import Renderer, render
from snowsplat.training.parts.part import Part
from snowsplat.training.parts.unseen_cameras import beside
from snowsplat.training.starts.point_colors import point_colors, point_pixels, sampled
from snowsplat.training.starts.source_views import source_views

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: The first and the last moment of an estimate, and the distance between two, in percent of the
#: schedule. Before the first one, the recipes use small photos. After the last one, few steps could
#: be saved.
_FIRST, _LAST, _EVERY = 45, 85, 5
#: The scene overfits if this number of estimates in a row are below the best one by at least this
#: difference in dB. In training runs without overfitting, one or two in a row can be that low.
_PATIENCE, _DIFFERENCE = 3, 0.2
#: The rest of the schedule is divided by this number.
_SHORTENING = 4

#: Largest number of unseen views. An estimate takes as long as a few steps.
_VIEWS = 12
#: An unseen view is this share of the distance between the two cameras beside the first of them.
_BESIDE = 0.5
#: The colours of a point in two photos may differ by this much in each channel, in units of white.
_SAME_COLOR = 0.1
#: Errors of a point are limited to this value, in units of white.
_LARGEST_ERROR = 0.2
#: Number of points with which the second photos are chosen.
_SAMPLE = 1000
#: With fewer points in all unseen views, there is no estimate.
_FEWEST_POINTS = 100
#: The largest estimate, in dB.
_HIGHEST_PSNR = 60.0


@dataclass(frozen=True)
class UnseenView:
    """A view without a photo, and the points whose colours are known there."""

    camera: Camera
    pixels: Tensor  # (P, 2) float32, on the CPU
    colors: Tensor  # (P, 3) float32 in 0..1, on the CPU


@dataclass(frozen=True)
class Overfitting:
    """The training found that the scene overfits after ``step`` of ``planned`` steps."""

    step: int
    planned: int


class OverfittingCheck(Part):
    """Computes estimates between the steps of a training run, and shortens its schedule.

    Attributes:
        found: None as long as the scene does not overfit.
    """

    name = "overfitting"

    def __init__(self) -> None:
        self.found: Overfitting | None = None
        self._run: Run
        self._unseen: list[UnseenView] | None = None  # computed at the first estimate
        self._estimates = 0  # number of estimates until now
        self._best = 0.0  # dB
        self._worse = 0  # number of estimates since the last one that was not worse

    def begin(self, run: Run) -> None:
        """Remember the run, whose schedule may be shortened."""
        self._run = run

    def between(self, run: Run) -> None:
        """Estimate if it is time; shorten the schedule if the scene overfits.

        Raises: UserError: a photo is missing or damaged.
        """
        step, schedule, dataset = run.step, run.schedule, run.dataset
        percent = _FIRST + _EVERY * self._estimates
        moment = schedule.step_of(percent / 100.0)
        if self.found is not None or percent > _LAST or step < moment:
            return
        if schedule.iterations * _EVERY < 100 * len(dataset.train):
            return
        self._estimates += 1
        background = run.background.evaluation
        if self._unseen is None:
            views = [v for i, v in enumerate(dataset.train) if i not in run.left_out]
            xyz = torch.zeros(0, 3) if dataset.points is None else dataset.points.xyz.cpu()
            self._unseen = unseen_views(views, xyz, run.photos, background.cpu())
        if not self._unseen:
            return
        estimate = estimated_psnr(
            run.gaussians, self._unseen, background, run.sh_degree, run.render
        )
        self._best = max(self._best, estimate)
        self._worse = self._worse + 1 if estimate <= self._best - _DIFFERENCE else 0
        if self._worse < _PATIENCE:
            return
        planned = schedule.iterations
        rest = math.ceil((planned - step) / _SHORTENING)
        if step + rest < planned:
            self.found = Overfitting(step, planned)
            schedule.stretch(step, step + rest)
            self._tell()

    def line(self) -> str | None:
        """The line about a training run that ends early; None if it does not."""
        iterations = self._run.schedule.iterations
        # A resumed training run with more steps may continue, although it has ended early before.
        if self.found is None or iterations >= self.found.planned:
            return None
        return (
            f"stopped after {iterations} of {self.found.planned} steps: the views between the "
            "photos became worse"
        )

    def _tell(self) -> None:
        if (line := self.line()) is not None:
            self._run.note(line)

    def state(self) -> dict[str, Tensor]:
        """The state on which the next checks depend, besides dataset and schedule."""
        found = self.found or Overfitting(0, 0)
        counts = [self._estimates, self._worse, found.step, found.planned]
        return {
            "counts": torch.tensor(counts),
            "best": torch.tensor(self._best, dtype=torch.float64),
        }

    def load(self, tensors: dict[str, Tensor]) -> None:
        """See `Part.load`."""
        self._estimates, self._worse, step, planned = tensors["counts"].tolist()
        self._best = float(tensors["best"])
        self.found = Overfitting(step, planned) if step > 0 else None
        self._tell()


def unseen_views(
    views: Sequence[View], points: Tensor, images: Photos, background: Tensor
) -> list[UnseenView]:
    """At most 12 unseen views with their points.

    Args:
        views: views with photos.
        points: (P, 3) in the world frame.
        background: (3,) colour in 0..1.

    Returns: Empty if too few points have the same colour in two photos.

    Raises: UserError: a photo is missing or damaged.
    """
    cameras = [view.camera for view in views]
    sample = points[:: max(1, len(points) // _SAMPLE)]
    second = source_views(cameras, sample, 1)
    pairs = [(i, chosen[0]) for i, chosen in enumerate(second) if chosen]
    pairs = pairs[:: max(1, -(-len(pairs) // _VIEWS))]
    images.prefetch([views[i] for pair in pairs for i in pair])
    unseen = []
    for i, j in pairs:
        camera = beside(cameras[i], cameras[j], _BESIDE)
        first, known = point_colors(views[i], images, points, background)
        other, also_known = point_colors(views[j], images, points, background)
        pixels, inside = point_pixels(camera, points)
        same = (first - other).abs().amax(1) <= _SAME_COLOR
        chosen = known & also_known & inside & same
        unseen.append(UnseenView(camera, pixels[chosen], 0.5 * (first + other)[chosen]))
    return unseen if sum(len(view.pixels) for view in unseen) >= _FEWEST_POINTS else []


@torch.no_grad()
def estimated_psnr(
    gaussians: Gaussians,
    unseen: Sequence[UnseenView],
    background: Tensor,
    sh_degree: int,
    render: Renderer = render,
) -> float:
    """The estimate of the module's docstring in dB, 14 to 60.

    Args:
        unseen: views with at least one point in total.
        background: (3,) colour in 0..1, on the device of the Gaussians.
        sh_degree: degree of the spherical harmonics in use.
    """
    device = gaussians.means.device
    total, count = 0.0, 0
    for view in unseen:
        image = render(gaussians, view.camera.to(device), background, sh_degree).image
        found = sampled(image.clamp(0.0, 1.0), view.pixels.to(device))
        error = (found - view.colors.to(device)).to(torch.float64).square().mean(1)
        total += float(error.clamp(max=_LARGEST_ERROR**2).sum())
        count += len(error)
    return -10.0 * math.log10(max(total / count, 10.0 ** (-_HIGHEST_PSNR / 10.0)))
