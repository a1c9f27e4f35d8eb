"""A small U-Net: a photo -> the depth of each pixel, and the size and opacity of its Gaussian."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from scenes import FOCAL
from snowsplat.extras.lift.lift import OPACITY, discs
from snowsplat.extras.lift.surface import find_links, surface_of
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians

# Standard deviation of the disc of a pixel, in pixels. The second views have the resolution of the
# photos, so smaller discs than those of `snowsplat lift` leave no gaps.
_SIGMA = 0.4
_WIDTHS = (16, 32, 64, 96)
_GROUPS = 8


@dataclass(frozen=True)
class Prediction:
    """What the network says about N photos.

    Attributes:
        log_depth: (N, H, W), the logarithm of camera z in metres, for a camera of focal length
            `FOCAL`.
        log_size: (N, H, W), the logarithm of the size of the Gaussians, in units of `_SIGMA`.
        opacity: (N, H, W), in (0, 1).
    """

    log_depth: Tensor
    log_size: Tensor
    opacity: Tensor

    def gaussians(self, i: int, image: Tensor, camera: Camera, scale: float = 1.0) -> Gaussians:
        """One Gaussian per pixel of photo ``i``; depths are multiplied by ``scale``."""
        depth = self.log_depth[i].exp() * scale
        surface = surface_of(depth, camera, find_links(depth))
        return discs(
            surface.points.flatten(0, 1),
            surface.tangents.flatten(0, 1),
            image.flatten(0, 1),
            camera,
            sigma=_SIGMA * self.log_size[i].flatten().exp(),
            opacity=self.opacity[i].flatten(),
        )


def without_offsets(log_depth: Tensor) -> Prediction:
    """A prediction of depths (N, H, W) alone, with opaque discs of one size."""
    return Prediction(log_depth, torch.zeros_like(log_depth), torch.full_like(log_depth, OPACITY))


def with_resampling(net: DepthNet, focal: float) -> Callable[[Tensor], Prediction]:
    """The network, for photos of a longer focal length, which are first scaled down.

    A photo is scaled by `FOCAL` / ``focal`` and placed in the middle of a photo of the training.
    Then each of its pixels has the ray that it has in the training. The border repeats the
    outermost pixels.
    """

    def predict(images: Tensor) -> Prediction:
        size = images.shape[1]
        small = 2 * round(size * FOCAL / focal / 2)
        margin = (size - small) // 2
        planes = F.interpolate(
            images.permute(0, 3, 1, 2), (small, small), mode="bilinear", antialias=True
        )
        padded = F.pad(planes, [margin] * 4, mode="replicate")
        whole = net(padded.permute(0, 2, 3, 1))

        def cut(values: Tensor) -> Tensor:
            middle = values[:, None, margin : margin + small, margin : margin + small]
            return F.interpolate(middle, (size, size), mode="bilinear")[:, 0]

        return Prediction(cut(whole.log_depth), cut(whole.log_size), cut(whole.opacity))

    return predict


def _block(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, padding=1),
        nn.GroupNorm(_GROUPS, outputs),
        nn.SiLU(),
        nn.Conv2d(outputs, outputs, 3, padding=1),
        nn.GroupNorm(_GROUPS, outputs),
        nn.SiLU(),
    )


class DepthNet(nn.Module):
    """A U-Net (Ronneberger et al. 2015) with four levels."""

    def __init__(self, mean_log_depth: float) -> None:
        super().__init__()
        pairs = list(zip((3, *_WIDTHS), _WIDTHS, strict=False))
        self.down = nn.ModuleList(_block(a, b) for a, b in pairs)
        self.up = nn.ModuleList(
            _block(coarse + fine, fine)
            for fine, coarse in zip(_WIDTHS[-2::-1], _WIDTHS[:0:-1], strict=True)
        )
        self.pool = nn.AvgPool2d(2)
        self.grow = nn.Upsample(scale_factor=2, mode="bilinear")
        self.head = nn.Conv2d(_WIDTHS[0], 3, 1)
        # The first prediction is the mean depth, with the discs of `without_offsets`.
        nn.init.zeros_(self.head.weight)
        bias = [mean_log_depth, 0.0, math.log(OPACITY / (1 - OPACITY))]
        self.head.bias.data.copy_(torch.tensor(bias))

    def forward(self, images: Tensor) -> Prediction:
        """Predict from images (N, H, W, 3) in 0..1; H and W are multiples of 8."""
        x = images.permute(0, 3, 1, 2) * 4 - 2
        kept = []
        for i, block in enumerate(self.down):
            x = block(x if i == 0 else self.pool(x))
            kept.append(x)
        kept.pop()
        for block in self.up:
            x = block(torch.cat([self.grow(x), kept.pop()], dim=1))
        log_depth, size, opacity = self.head(x).unbind(1)
        return Prediction(log_depth, size.tanh(), opacity.sigmoid().clamp(0.01, 0.995))

    def weights(self) -> int:
        """The number of weights."""
        return sum(parameter.numel() for parameter in self.parameters())


def focal_scale(focal: float) -> float:
    """Metric depth divided by predicted depth, for photos of another focal length.

    An object of a given size in the image is farther away if the focal length is longer, in
    proportion.
    """
    return focal / FOCAL
