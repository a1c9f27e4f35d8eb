"""An image as a SIREN: a small network with sine activations (Sitzmann et al. 2020, NeurIPS).

The network maps the position of a pixel, in −1..1, to its colour, in −1..1. Weights are initialised
as in section 3.2 of the paper: uniform in ±1/in for the first layer, in ±√(6/in)/ω₀ for the others,
with ω₀ = 30.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

_OMEGA = 30.0
_LAYERS = 3


@dataclass
class SirenFit:
    """The result of `fit_siren`: the image (H, W, 3), and the number of weights."""

    image: Tensor
    parameters: int


class _Sine(nn.Module):
    def __init__(self, inputs: int, outputs: int, first: bool) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)
        bound = 1 / inputs if first else math.sqrt(6 / inputs) / _OMEGA
        nn.init.uniform_(self.linear.weight, -bound, bound)

    def forward(self, values: Tensor) -> Tensor:
        return torch.sin(_OMEGA * self.linear(values))


def siren(hidden: int, layers: int) -> nn.Module:
    """A network 2 → hidden → … → 3 with `layers` sine layers."""
    sines = [_Sine(2, hidden, first=True)]
    sines += [_Sine(hidden, hidden, first=False) for _ in range(layers - 1)]
    last = nn.Linear(hidden, 3)
    bound = math.sqrt(6 / hidden) / _OMEGA
    nn.init.uniform_(last.weight, -bound, bound)
    return nn.Sequential(*sines, last)


def hidden_size(parameters: int) -> int:
    """The size of the hidden layers whose 2h² + 8h + 3 weights come closest to `parameters`."""
    return max(1, round(math.sqrt(4 + (parameters - 3) / 2) - 2))


def fit_siren(target: Tensor, hidden: int, steps: int, seed: int, rate: float = 1.0) -> SirenFit:
    """Fit a SIREN to target (H, W, 3) in 0..1 with Adam, on all pixels, for the squared error.

    It has three sine layers of `hidden` units. `rate` is a factor of the learning rate.
    """
    torch.manual_seed(seed)
    height, width = target.shape[:2]
    y, x = torch.meshgrid(
        torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij"
    )
    positions = torch.stack([x, y], dim=2).reshape(-1, 2)
    wanted = target.reshape(-1, 3) * 2 - 1
    network = siren(hidden, _LAYERS)
    optimizer = torch.optim.Adam(network.parameters(), lr=rate * 2e-3)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.02 ** (1 / steps))
    for _ in range(steps):
        loss = (network(positions) - wanted).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        image = (network(positions) + 1) / 2
    weights = sum(p.numel() for p in network.parameters())
    return SirenFit(image.reshape(height, width, 3), weights)
