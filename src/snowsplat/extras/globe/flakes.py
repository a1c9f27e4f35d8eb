"""How a Gaussian looks while it is snow: small, opaque, brighter, and turned.

The page does the same on the GPU (`web/splats.vert`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from snowsplat.extras.globe.physics import FLAKE, Snow, random_numbers
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import quat_product
from snowsplat.scene.sh_constants import SH_C0

#: The colour of a flake: that of the Gaussian with its largest channel at 1, but at most this many
#: times as bright, mixed with a share of white.
BRIGHTER = 2.5
WHITE = 0.58
#: Opacity of a flake, unless the Gaussian is more opaque.
OPAQUE = 0.9


def appearance(gaussians: Gaussians, snow: Snow) -> Gaussians:
    """The Gaussians of the scene, in the frame of the globe, in a state of the simulation ``snow``,
    which has them in the same order. If they all stand, the result equals ``gaussians``.
    """
    morph = torch.from_numpy(snow.morph)
    low, high = (math.log(radius) for radius in FLAKE)
    scales = gaussians.log_scales
    opacities = gaussians.opacities
    colors = gaussians.base_colors
    bright = colors / colors.amax(1, keepdim=True).clamp(1.0 / BRIGHTER, 1.0)
    change = bright + WHITE * (1.0 - bright) - colors
    return replace(
        gaussians,
        means=torch.from_numpy(snow.position.T.copy()),
        log_scales=scales + morph[:, None] * (scales.clamp(low, high) - scales),
        quats=quat_product(_spin(snow), gaussians.rotations),
        opacity_logits=torch.where(
            morph > 0,
            (opacities + morph * (opacities.clamp_min(OPAQUE) - opacities)).logit(1e-6),
            gaussians.opacity_logits,
        ),
        sh_dc=gaussians.sh_dc + (morph[:, None] * change / SH_C0)[:, None],
        sh_rest=gaussians.sh_rest * (1.0 - morph)[:, None, None],
    )


def spin_axes(count: int) -> np.ndarray:
    """(3, count) float32: unit vectors around which flakes turn, evenly distributed."""
    z = 2.0 * random_numbers(count, 9) - 1.0
    azimuth = 2.0 * math.pi * random_numbers(count, 10)
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z]).astype(np.float32)


def _spin(snow: Snow) -> Tensor:
    half = 0.5 * snow.angle
    turn = np.concatenate([np.cos(half)[None], np.sin(half) * spin_axes(len(half))])
    return torch.from_numpy(turn.T.copy())
