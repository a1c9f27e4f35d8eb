"""`History`: the curves of a training, as some hundred points however long it is."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from snowsplat.util.files import write_json
from snowsplat.util.safe_json import from_json, read_json

#: Most points of a curve; when there are more, neighbours become one.
MOST_POINTS = 400
_ABSURD = 1e30


@dataclass(frozen=True)
class Stretch:
    """Some steps one after the other, and what they were like."""

    step: int  # the last of them
    steps: int  # how many
    loss: float  # their mean
    seconds: float  # of them all; what happens between two steps does not count
    gaussians: int  # after the last

    def then(self, other: Stretch) -> Stretch:
        """This one and the next as one."""
        steps = self.steps + other.steps
        loss = (self.steps * self.loss + other.steps * other.loss) / steps
        return Stretch(other.step, steps, loss, self.seconds + other.seconds, other.gaussians)


@dataclass(frozen=True)
class Measured:
    """Mean figures of the held-out views after a step."""

    step: int
    psnr: float  # dB
    ssim: float


@dataclass
class History:
    """What is noted after each step: some microseconds' work, and memory that does not grow.

    A stretch has ``stride`` steps, the last one may have fewer.
    """

    stretches: list[Stretch] = field(default_factory=list)
    measured: list[Measured] = field(default_factory=list)
    stride: int = 1

    def __post_init__(self) -> None:
        self._since = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Of all steps."""
        return sum(stretch.seconds for stretch in self.stretches)

    def step_begins(self) -> None:
        """Its time is counted from now on."""
        self._since = time.perf_counter()

    def step_ends(self, step: int, loss: float, gaussians: int, timed: bool = True) -> None:
        """Its time is counted until now; if it is not ``timed``, it counts as the ones before."""
        seconds = time.perf_counter() - self._since
        if not timed and self.stretches:
            seconds = self.stretches[-1].seconds / self.stretches[-1].steps
        self._append(Stretch(step, 1, loss, seconds, gaussians))

    def measure(self, step: int, psnr: float, ssim: float) -> None:
        """Figures of a step, instead of those that it had."""
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
        """What `write` wrote, up to a step: a training may go on from before its end.

        Empty where the file is absent or damaged: these are curves to look at, and no reason not
        to go on with a training.
        """
        try:
            values = read_json(path)
            stretches = [from_json(Stretch, stretch) for stretch in values["stretches"]]
            measured = [from_json(Measured, measure) for measure in values["measured"]]
            if any(stretch.steps < 1 for stretch in stretches):
                raise ValueError("of no steps")
            figures = [f for s in stretches for f in (s.loss, s.seconds)]
            figures += [f for m in measured for f in (m.psnr, m.ssim)]
            if any(abs(figure) > _ABSURD for figure in figures):
                raise ValueError("sums of them are not finite")
            return cls(
                [stretch for stretch in stretches if stretch.step <= last_step],
                [measure for measure in measured if measure.step <= last_step],
                max(1, int(values["stride"])),
            )
        except (OSError, ValueError, TypeError, KeyError, OverflowError):
            return cls()
