"""`TrainingViewer`: updates the page between two training steps: its image, and curves."""

from __future__ import annotations

import itertools
import math
import time
from collections import deque
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from snowsplat.data import View
from snowsplat.data.photos.decode import load_image, load_mask, resize_area
from snowsplat.evaluation.metrics import psnr
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render
from snowsplat.util.errors import UserError
from snowsplat.util.image_size import scaled_size
from snowsplat.util.interrupts import raise_deferred_interrupt
from snowsplat.util.messages import Message
from snowsplat.util.process import single_threaded
from snowsplat.viewer.live.viewer import NetworkViewer

_SECONDS = 1.0  # time between two updates of the displayed numbers
_PSNR_SHARE = 0.03  # share of the time for measuring PSNR
_LOSS_STEPS = 50  # approximate number of steps over which the displayed loss is averaged
_RATE_SECONDS = 3.0  # approximate time over which the displayed steps per second are averaged
_POINTS = 512  # maximum number of points per curve; if there are more, adjacent ones are merged
_VIEWS = 4  # number of views whose PSNR is averaged
_MAX_SIDE = 480  # pixels: longer side of these views


class TrainingViewer:
    """Shows training on the page and can pause it; call `after_step` after each step."""

    def __init__(self, viewer: NetworkViewer, sampled_psnr: SampledPsnr) -> None:
        self.viewer = viewer
        self._session = viewer.session
        self._session.training = True
        self._sampled_psnr = sampled_psnr
        self._losses, self._psnrs = Curve(), Curve()
        self._loss = math.nan
        self._rate = 0.0
        self._rated = (0, time.monotonic())  # step and time at which the rate was last computed
        self._next = self._next_psnr = 0.0  # times of the next updates
        self._measured = 0  # step of the last PSNR
        self._points = 0, 0  # of the curves that the page shows
        self._tell()

    def after_step(self, step: int, steps: int, loss: float, gaussians: Gaussians) -> float:
        """Render the requested images and update the page; wait while the training is paused.

        Returns the seconds for which it was paused after ``step`` of ``steps`` finished steps.
        Raises: KeyboardInterrupt: Ctrl-C while the training was paused.
        """
        self._losses.add(step, loss)
        before = loss if math.isnan(self._loss) else self._loss
        self._loss = before + (loss - before) / _LOSS_STEPS
        if not self._session.busy:
            return 0.0
        self.viewer.serve(gaussians, step, training=True)
        self._update_panel(step, steps, gaussians)
        if self._session.may_step():
            return 0.0
        started = time.monotonic()
        self._next = 0.0
        while True:
            self._update_panel(step, steps, gaussians)
            if not self.viewer.serve(gaussians, step, training=False):
                self.viewer.wait()
            raise_deferred_interrupt()
            if self._session.may_step():
                return time.monotonic() - started

    def _update_panel(self, step: int, steps: int, gaussians: Gaussians) -> None:
        """Update the displayed numbers and curves, at most once per `_SECONDS`."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + _SECONDS
        if self._sampled_psnr.can_measure and step > self._measured and now >= self._next_psnr:
            psnr = self._sampled_psnr.measure(gaussians)
            self._measured = step
            if math.isfinite(psnr):
                self._psnrs.add(step, psnr)
            took = time.monotonic() - now
            self._next_psnr = now + took / _PSNR_SHARE
        psnrs = self._psnrs.lists()[1]
        self._tell(
            step=step,
            steps=steps,
            rate=None if self._session.paused else self._steps_per_second(step),
            gaussians=len(gaussians),
            loss=self._loss,
            psnr=psnrs[-1] if psnrs else None,
        )
        self._tell_curves()

    def _tell(self, **figures: object) -> None:
        """Show the state of the training on all pages."""
        session = self._session
        control = {"paused": session.paused, "share": session.share}
        self.viewer.tell({"type": "training", **control, **figures})

    def _tell_curves(self) -> None:
        """Show the curves on all pages, if they have new points."""
        points = len(self._losses), len(self._psnrs)
        if points != self._points:
            self._points = points
            curves = {"loss": self._losses.lists(), "psnr": self._psnrs.lists()}
            self.viewer.tell({"type": "curves", **curves})

    def _steps_per_second(self, step: int) -> float:
        now = time.monotonic()
        step_before, before = self._rated
        self._rated = step, now
        if now - before < 2.0 * _RATE_SECONDS and step > step_before:
            rate = (step - step_before) / (now - before)
            keep = math.exp((before - now) / _RATE_SECONDS) if self._rate else 0.0
            self._rate = keep * self._rate + (1.0 - keep) * rate
        return self._rate

    def end(self, about: Sequence[Message]) -> None:
        """The training has finished: show lines of text about it instead of its controls."""
        self._session.training = False
        self._session.resume()
        self._tell(finished=[line.in_all_languages() for line in about])
        self._tell_curves()

    def show(self, step: int, gaussians: Gaussians) -> None:
        """Show the result of the training until Ctrl-C, which raises KeyboardInterrupt."""
        while True:
            if not self.viewer.serve(gaussians, step, training=False):
                self.viewer.wait()


class Curve:
    """The curve of a value. Each point is the mean of equally many added values.

    The number of points is limited: adjacent points are merged if there are too many.
    """

    def __init__(self) -> None:
        self._points: list[tuple[float, float]] = []
        self._every = 1  # values per point
        self._steps = self._sum = 0.0
        self._count = 0

    def add(self, step: int, value: float) -> None:
        """Add the value of a step."""
        self._steps += step
        self._sum += value
        self._count += 1
        if self._count < self._every:
            return
        self._points.append((self._steps / self._count, self._sum / self._count))
        self._steps = self._sum = 0.0
        self._count = 0
        if len(self._points) > _POINTS:
            pairs = zip(self._points[::2], self._points[1::2], strict=False)
            self._points = [((a + c) / 2, (b + d) / 2) for (a, b), (c, d) in pairs]
            self._every *= 2

    def __len__(self) -> int:
        return len(self._points)

    def lists(self) -> tuple[list[float], list[float]]:
        """The steps and the values of the points."""
        return [step for step, _ in self._points], [value for _, value in self._points]


class SampledPsnr:
    """PSNR of a few fixed views, measured one at a time, because this delays the training."""

    def __init__(self, views: Sequence[View], background: Tensor) -> None:
        """``views``: `_VIEWS` of them are used, evenly spaced; ``background``: (3,) in 0..1."""
        self._background = background
        chosen = [views[i * len(views) // _VIEWS] for i in range(_VIEWS)] if views else []
        unique = list(dict.fromkeys(chosen))
        self._turn = itertools.cycle(unique)
        self._photos: dict[View, tuple[Tensor, Tensor | None]] = {}
        self._newest: deque[float] = deque(maxlen=len(unique))
        self.can_measure = bool(unique)

    def measure(self, gaussians: Gaussians) -> float:
        """Measure the next view (the first time: all views); return the mean of the PSNRs in dB.

        NaN if a photo cannot be read.
        """
        for _ in range(1 if self._newest else self._newest.maxlen or 0):
            self._measure_next(gaussians)
        return sum(self._newest) / len(self._newest) if self.can_measure else math.nan

    @torch.no_grad()
    def _measure_next(self, gaussians: Gaussians) -> None:
        view = next(self._turn)
        size = scaled_size(view.camera.width, view.camera.height, _MAX_SIDE)
        with single_threaded():
            try:
                photo, mask = self._photo(view, size)
            except UserError:
                self.can_measure = False  # the training itself reports the error
                return
            image = render(gaussians, view.camera.scaled(*size), self._background).image
            self._newest.append(psnr(image.clamp(0.0, 1.0).cpu(), photo, mask))

    def _photo(self, view: View, size: tuple[int, int]) -> tuple[Tensor, Tensor | None]:
        if view not in self._photos:
            planes = load_image(view.image, self._background.tolist())
            small = torch.from_numpy(resize_area(planes.numpy(), *size))
            mask = None
            if view.mask is not None:
                whole = load_mask(view.mask).numpy().astype(np.uint8)[None] * 255
                mask = torch.from_numpy(resize_area(whole, *size)[0] == 255)
            self._photos[view] = (small.permute(1, 2, 0).to(torch.float32) / 255.0, mask)
        return self._photos[view]
