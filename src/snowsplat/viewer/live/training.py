"""`TrainingViewer`: updates the page between two training steps."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.interrupts import raise_deferred_interrupt
from snowsplat.util.messages import Message
from snowsplat.viewer.live.curves import Curve, SampledPsnr
from snowsplat.viewer.live.viewer import NetworkViewer

_SECONDS = 1.0  # time between two updates of the displayed numbers
_PSNR_SHARE = 0.03  # share of the time for measuring PSNR
_LOSS_STEPS = 50  # approximate number of steps over which the displayed loss is averaged
_RATE_SECONDS = 3.0  # approximate time over which the displayed steps per second are averaged


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
