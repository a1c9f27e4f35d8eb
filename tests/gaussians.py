"""Gaussians at random."""

from types import SimpleNamespace

import torch
from torch import Tensor

from snowsplat.scene.gaussians import Gaussians


def gaussians_in_box(
    bounds: Tensor,
    n: int,
    generator: torch.Generator,
    sh_degree: int = 3,
    initial_opacity: float = 0.1,
) -> Gaussians:
    """``n`` Gaussians with random colours and positions in a box, ``bounds`` (2, 3)."""
    low, high = bounds.to(torch.float32)
    xyz = low + (high - low) * torch.rand(n, 3, generator=generator)
    rgb = torch.randint(0, 256, (n, 3), generator=generator, dtype=torch.uint8)
    return Gaussians.from_points(SimpleNamespace(xyz=xyz, rgb=rgb), sh_degree, initial_opacity)
