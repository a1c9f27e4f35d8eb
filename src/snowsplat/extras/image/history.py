"""`Moment`: PSNR and SSIM of the image after a step of a fit."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Moment:
    """The state of a fit after a step."""

    step: int
    seconds: float  # time spent in steps so far
    gaussians: int
    psnr: float  # dB
    ssim: float


def recorded_steps(steps: int, count: int) -> list[int]:
    """At most `count` steps from 1 to `steps`, at first close together.

    The k-th of them is proportional to k²: the image changes most in the first steps.
    """
    return sorted({max(1, round(steps * (k / count) ** 2)) for k in range(1, count + 1)})
