"""Gaussians at random."""

from types import SimpleNamespace

import torch
from torch import Tensor

from snowsplat.scene.gaussians import SH_REST_COUNTS, Gaussians


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


def normal_gaussians(
    n: int, sh_degree: int, seed: int = 0, dtype: torch.dtype = torch.float32
) -> Gaussians:
    """``n`` Gaussians whose parameters are standard normal."""
    generator = torch.Generator().manual_seed(seed)
    shapes = (n, 3), (n, 3), (n, 4), (n,), (n, 1, 3), (n, SH_REST_COUNTS[sh_degree], 3)
    return Gaussians(*(torch.randn(s, generator=generator, dtype=dtype) for s in shapes))


def assert_identical(a: Gaussians, b: Gaussians) -> None:
    assert a.antialiased == b.antialiased
    for name, parameter in a.parameters().items():
        assert torch.equal(parameter, b.parameters()[name]), name
