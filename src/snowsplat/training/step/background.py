"""`Background`: the colour behind the scene in each step."""

from __future__ import annotations

import torch
from torch import Tensor

#: Background colours by name; "random" is drawn in each step.
FIXED_BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


class Background:
    """The background of ``TrainConfig.background``.

    Attributes:
        fixed: RGB in 0..1; None: another colour in each step.
        evaluation: (3,) on the device: the colour for evaluations; black replaces a random one.
    """

    def __init__(self, name: str, generator: torch.Generator, device: torch.device) -> None:
        """
        Args:
            name: of `FIXED_BACKGROUNDS`, or "random".
            generator: draws the random colours, on the CPU.
        """
        self.fixed = FIXED_BACKGROUNDS.get(name)
        self.evaluation = torch.tensor(self.fixed or FIXED_BACKGROUNDS["black"], device=device)
        self._generator = generator

    def draw(self) -> Tensor:
        """(3,) on the device: the colour of the next view."""
        if self.fixed is not None:
            return self.evaluation
        color = torch.rand(3, generator=self._generator)
        return color.to(self.evaluation.device, non_blocking=True)
