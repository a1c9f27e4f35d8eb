"""The depth of the surface in a view of Gaussians, and how reliable it is.

The surface of a pixel is at the Gaussian at which the transmittance falls below 1/2: the median
depth. A mean of depths would be in the air at the edge of an object. The Gaussian is not a plane
that faces the camera. Along the ray t d it is densest at t = (dᵀ M μ) / (dᵀ M d), with its centre
μ in the frame of the camera and M = Σ⁻¹ (as in RaDe-GS, Zhang et al. 2024). To first order around
the direction d₀ of its centre, and exactly for flat Gaussians, the inverse depth is linear in the
pixel:

    1 / t = g · d / z,   g = M d₀ / (d₀ᵀ M d₀),   μ = z d₀

So the three coefficients of 1 / t are blended in place of a colour.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops.splats import COLORS, Splats2D, packed_width
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.scene.render import project

#: A pixel shows a surface if alpha is at least the first number, and none below the second.
_COVERED, _EMPTY = 0.5, 0.05
#: Weight of a pixel that shows no surface, relative to one that shows a surface from the front.
_EMPTY_WEIGHT = 0.5
#: The slope of a Gaussian is limited to this tangent: behind it is rounding.
_STEEPEST = 10.0
#: Mean and median depth that differ by this share halve the weight.
_SPREAD = 0.05
_FLATTEST = 1e-3  # the smallest scale of a Gaussian, relative to the largest


@dataclass(frozen=True)
class DepthMap:
    """The surface in a view; ``camera`` has the size of the map.

    Attributes:
        depth: (H, W) float32, camera z in world units. 0: unknown; infinite: no surface.
        weight: (H, W) uint8: the confidence of the depth, 255 at most.
    """

    camera: Camera
    depth: Tensor
    weight: Tensor

    @property
    def confidence(self) -> Tensor:
        """(H, W) float32, 0 to 1."""
        return self.weight.to(torch.float32) / 255.0

    def corrected(self, empty: Tensor | None, usable: Tensor | None) -> DepthMap:
        """The map with what is known from the photo, each (H, W) bool or None.

        ``empty``: pixels that show no surface. ``usable``: False where nothing is known.
        """
        depth, weight = self.depth, self.weight
        if empty is not None:
            empty = empty.to(depth.device)
            depth = torch.where(empty, math.inf, depth)
            weight = torch.where(empty, 255, weight).to(torch.uint8)
        if usable is not None:
            depth = torch.where(usable.to(depth.device), depth, 0.0)
        return DepthMap(self.camera, depth, weight)


class SurfaceRenderer:
    """Renders depth maps of one set of Gaussians."""

    def __init__(self, gaussians: Gaussians) -> None:
        self._gaussians = gaussians.detach()
        axes = rotation_from_quat(self._gaussians.quats)
        scales = self._gaussians.log_scales - self._gaussians.log_scales.amax(1, keepdim=True)
        flat = torch.exp(-2.0 * scales.clamp(min=math.log(_FLATTEST)))
        flat = flat / flat.amax(1, keepdim=True)
        # (N, 3, 3): Σ⁻¹ in the world frame, up to a factor of each Gaussian.
        self._precision = (axes * flat[:, None]) @ axes.transpose(1, 2)

    @torch.no_grad()
    def render(self, camera: Camera, reach: float = math.inf) -> DepthMap:
        """The depth map of a view; farther than ``reach``, in world units, there is no surface."""
        splats = self._splats(camera)
        median, mean, alpha = ops.rasterize_median(splats, camera.width, camera.height)
        x = torch.arange(camera.width, device=alpha.device) + (0.5 - camera.cx)
        y = torch.arange(camera.height, device=alpha.device)[:, None] + (0.5 - camera.cy)
        inverse, average = (c[..., 0] + x * c[..., 1] + y * c[..., 2] for c in (median, mean))
        known = (alpha >= _COVERED) & (inverse > 0.0)
        depth = torch.where(known, 1.0 / inverse, 0.0)
        # n · d = inverse depth, for the direction d of a pixel and the normal n.
        normal = median[..., 0] ** 2
        normal += (camera.fx * median[..., 1]) ** 2 + (camera.fy * median[..., 2]) ** 2
        ray = 1.0 + (x / camera.fx) ** 2 + (y / camera.fy) ** 2
        cosine = inverse * torch.rsqrt(normal * ray)
        spread = (average / (alpha * inverse) - 1.0) / _SPREAD
        weight = torch.where(known, alpha * cosine / (1.0 + spread**2), 0.0)
        empty = (alpha < _EMPTY) | (known & (depth > reach))
        depth = torch.where(empty, math.inf, depth)
        weight = torch.where(empty, _EMPTY_WEIGHT, weight.nan_to_num(0.0).clamp(0.0, 1.0))
        return DepthMap(camera, depth, (255.0 * weight).ceil().to(torch.uint8))

    def _splats(self, camera: Camera) -> Splats2D:
        """The splats of the view, with the coefficients of the inverse depth as colours."""
        splats = project(self._gaussians, camera, 0)
        assert splats.ids is not None
        rows = splats.ids.clamp(min=0)  # −1 marks empty rows on a GPU
        pose = camera.cam_from_world.to(self._precision)
        z = splats.depths.clamp_min(1e-30)[:, None]
        centre = camera.position.to(self._gaussians.means)
        towards = (self._gaussians.means[rows] - centre) / z
        g = torch.einsum("nij,nj->ni", self._precision[rows], towards)
        g = g / (g * towards).sum(1, keepdim=True)
        # Without its part along the ray, which is the same for all: the slope.
        square = (towards * towards).sum(1, keepdim=True)
        facing = towards / square
        slope = g - facing
        steepness = slope.norm(dim=1, keepdim=True) * square.sqrt()
        slope = slope * (_STEEPEST / steepness.clamp_min(_STEEPEST))
        g = (facing + slope.nan_to_num(0.0)) @ pose[:, :3].T / z
        packed = splats.packed.new_zeros(len(rows), packed_width(3))
        packed[:, :COLORS] = splats.packed[:, :COLORS]
        packed[:, COLORS] = g[:, 2]
        packed[:, COLORS + 1] = g[:, 0] / camera.fx
        packed[:, COLORS + 2] = g[:, 1] / camera.fy
        return Splats2D(packed, splats.ids, 3)
