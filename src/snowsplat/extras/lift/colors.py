"""Corrects the colours of discs, so that their image from the photo's camera is the photo."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render
from snowsplat.scene.sh_constants import SH_C0

# More steps reproduce the photo better, but other viewpoints worse: the colours then compensate for
# each other at this pose only.
_STEPS = 10


def match_photo(gaussians: Gaussians, camera: Camera, photo: Tensor) -> Gaussians:
    """Gaussians with the same geometry and opacity, whose colours reproduce the photo.

    Discs of neighbouring pixels overlap, so an image of discs in the colours of the photo is
    blurred. For a fixed geometry, the image is linear in the colours: I = W c. This minimises
    ‖W c − photo‖² for c in 0..1, by projected gradient steps that are scaled by 1 / (Wᵀ 1), with
    Nesterov's momentum (Beck and Teboulle 2009). The backward pass of the rasterizer computes
    Wᵀ x. Gaussians that are not visible keep their colours.

    ``gaussians`` have the SH degree 0; ``photo`` (H, W, 3) is in 0..1.
    """
    colors = gaussians.base_colors.clamp(0.0, 1.0)
    # The scaling bounds the step by the mean of a row of Wᵀ W, which its largest row may exceed.
    weights = _transposed(gaussians, camera, torch.full_like(colors, 0.5), None).clamp_min(1e-3)
    ahead, momentum = colors, 1.0
    for _ in range(_STEPS):
        step = _transposed(gaussians, camera, ahead, photo) / weights
        following = (ahead + step).clamp(0.0, 1.0)
        grown = 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * momentum * momentum))
        ahead = following + (momentum - 1.0) / grown * (following - colors)
        colors, momentum = following, grown
    return with_colors(gaussians, colors)


def with_colors(gaussians: Gaussians, colors: Tensor) -> Gaussians:
    """The Gaussians with the base colours (N, 3)."""
    return replace(gaussians, sh_dc=((colors - 0.5) / SH_C0)[:, None, :])


def _transposed(
    gaussians: Gaussians, camera: Camera, colors: Tensor, photo: Tensor | None
) -> Tensor:
    """(N, 3): Wᵀ (photo − W c), or Wᵀ 1 without a photo."""
    colors = colors.detach().requires_grad_()
    with torch.enable_grad():
        image = render(with_colors(gaussians, colors), camera).image
    residual = torch.ones_like(image) if photo is None else photo - image.detach()
    return torch.autograd.grad(image, colors, residual)[0]
