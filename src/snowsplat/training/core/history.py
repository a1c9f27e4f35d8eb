"""`History`: the curves of a training run, with a few hundred points for any number of steps."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from snowsplat.util.files import write_json
from snowsplat.util.safe_json import from_json, read_json

#: Maximum number of points of a curve. If there are more, adjacent points are merged.
MOST_POINTS = 400
#: Larger values in a file are rejected, because sums of them may not be finite.
_LARGEST_VALUE = 1e30


@dataclass(frozen=True)
class Stretch:
    """A number of consecutive steps."""

    step: int  # the last step
    steps: int  # number of steps
    loss: float  # mean of the losses of the steps
    seconds: float  # total time of the steps, without the time between steps
    gaussians: int  # the number of Gaussians after the last step

    def then(self, other: Stretch) -> Stretch:
        """This stretch and the next one, merged."""
        steps = self.steps + other.steps
        loss = (self.steps * self.loss + other.steps * other.loss) / steps
        return Stretch(other.step, steps, loss, self.seconds + other.seconds, other.gaussians)


@dataclass(frozen=True)
class Measured:
    """Mean metrics of the held-out views after a step; PSNR in dB."""

    step: int
    psnr: float
    ssim: float


@dataclass
class History:
    """Loss, time and number of Gaussians of all steps, as at most `MOST_POINTS` stretches.

    Recording a step takes a few microseconds. A stretch has ``stride`` steps; the last one may have
    fewer.
    """

    stretches: list[Stretch] = field(default_factory=list)
    measured: list[Measured] = field(default_factory=list)
    stride: int = 1

    def __post_init__(self) -> None:
        self._since = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Total time of all steps."""
        return sum(stretch.seconds for stretch in self.stretches)

    def step_begins(self) -> None:
        """Start measuring the time of a step."""
        self._since = time.perf_counter()

    def step_ends(self, step: int, loss: float, gaussians: int, timed: bool = True) -> None:
        """Record a step. If not ``timed``, the mean time of the previous stretch is used for it."""
        seconds = time.perf_counter() - self._since
        if not timed and self.stretches:
            seconds = self.stretches[-1].seconds / self.stretches[-1].steps
        self._append(Stretch(step, 1, loss, seconds, gaussians))

    def measure(self, step: int, psnr: float, ssim: float) -> None:
        """Record metrics after a step, replacing earlier ones of the same step."""
        self.measured = [m for m in self.measured if m.step != step]
        self.measured.append(Measured(step, psnr, ssim))

    def _append(self, stretch: Stretch) -> None:
        if self.stretches and self.stretches[-1].steps + stretch.steps <= self.stride:
            self.stretches[-1] = self.stretches[-1].then(stretch)
            return
        self.stretches.append(stretch)
        if len(self.stretches) > MOST_POINTS:
            self.stride *= 2
            stretches, self.stretches = self.stretches, []
            for one in stretches:
                self._append(one)

    # As a file

    def write(self, path: Path) -> None:
        """Write JSON, atomically."""
        write_json(path, asdict(self))

    @classmethod
    def read(cls, path: Path, last_step: int) -> History:
        """Read the file, but only up to ``last_step``: the step from which training resumes.

        Returns an empty history if the file is missing or damaged, because curves are not needed to
        resume training.
        """
        try:
            values = read_json(path)
            stretches = [from_json(Stretch, stretch) for stretch in values["stretches"]]
            measured = [from_json(Measured, measure) for measure in values["measured"]]
            if any(stretch.steps < 1 for stretch in stretches):
                raise ValueError("a stretch without steps")
            values_read = [v for s in stretches for v in (s.loss, s.seconds)]
            values_read += [v for m in measured for v in (m.psnr, m.ssim)]
            if any(abs(value) > _LARGEST_VALUE for value in values_read):
                raise ValueError("values too large")
            return cls(
                [stretch for stretch in stretches if stretch.step <= last_step],
                [measure for measure in measured if measure.step <= last_step],
                max(1, int(values["stride"])),
            )
        except (OSError, ValueError, TypeError, KeyError, OverflowError):
            return cls()
