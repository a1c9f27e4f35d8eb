"""The frusta and the surroundings of cameras, for `points_in_frusta` and `points_in_spheres`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.ops import Frusta
from snowsplat.scene.camera import Camera


def frusta_of(cameras: Sequence[Camera], depths: Sequence[tuple[float, float]]) -> Frusta:
    """The frusta of V cameras, in float64 on their device.

    ``depths``: for each camera the range of depths, world units.
    """
    double, device = torch.float64, cameras[0].cam_from_world.device
    size = [(c.width, c.height) for c in cameras]
    return Frusta(
        torch.stack([c.intrinsics.to(device) @ c.cam_from_world.to(double) for c in cameras]),
        torch.tensor(size, dtype=double, device=device),
        torch.tensor(depths, dtype=double, device=device),
        torch.tensor([max(c.fx, c.fy) for c in cameras], dtype=double, device=device),
    )


def spheres_of(cameras: Sequence[Camera], radii: Sequence[float]) -> Tensor:
    """(C, 4) float32: the centres of cameras, and a radius for each, in world units; on the CPU."""
    pairs = zip(cameras, radii, strict=True)
    return torch.tensor([[*c.position.tolist(), radius] for c, radius in pairs])
