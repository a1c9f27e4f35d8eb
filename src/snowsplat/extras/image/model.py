"""`ImageGaussians`: 2D Gaussians whose blended colours are an image."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.extras.image.options import Blending
from snowsplat.ops.splats import Splats2D

# Columns of `ImageGaussians.rows`.
MEANS = slice(0, 2)
LOG_SIGMAS = slice(2, 4)
ANGLE = 4
COLORS = slice(5, 8)
OPACITY_LOGIT = 8


def column_count(blending: Blending) -> int:
    """Number of columns of `ImageGaussians.rows`: additive Gaussians have no opacity."""
    return 8 if blending == "additive" else 9


@dataclass(frozen=True)
class ImageGaussians:
    """2D Gaussians on an image, in pixels. Pixel (i, j) is centred at (i + 0.5, j + 0.5).

    The columns of a row of `rows`:

        0:2   x, y of the centre
        2:4   log σ along the two axes
        4     angle between the x axis of the image and the first axis, in radians
        5:8   red, green, blue; 1 is white. Colours of additive Gaussians may be negative
        8     logit of the opacity; only for front-to-back blending
    """

    width: int  # of the image, in pixels
    height: int  # of the image, in pixels
    blending: Blending  # how the Gaussians are blended
    # (N, 8) for additive, (N, 9) for front-to-back blending, float32. In the latter, the first row
    # is in front.
    rows: Tensor
    background: Tensor  # (3,) the colour behind the Gaussians, float32

    def __post_init__(self) -> None:
        columns = column_count(self.blending)
        if self.rows.dim() != 2 or self.rows.shape[1] != columns:
            raise ValueError(
                f"ImageGaussians: rows must be (N, {columns}) for {self.blending} blending, "
                f"got {tuple(self.rows.shape)}"
            )

    def __len__(self) -> int:
        return len(self.rows)

    def splats(self, scale: float = 1.0) -> Splats2D:
        """The rows as splats of an image that is `scale` times as large; differentiable.

        The covariance is R diag(σ₁², σ₂²) Rᵀ, where R rotates by the angle. Its inverse, the conic,
        is R diag(σ₁⁻², σ₂⁻²) Rᵀ.
        """
        x, y, log_u, log_v, angle, red, green, blue, *logits = self.rows.unbind(dim=1)
        cos, sin = torch.cos(angle), torch.sin(angle)
        u, v = torch.exp(-2 * log_u), torch.exp(-2 * log_v)
        a, b, c = cos * cos * u + sin * sin * v, cos * sin * (u - v), sin * sin * u + cos * cos * v
        if scale != 1.0:
            x, y = x * scale, y * scale
            a, b, c = (value / scale**2 for value in (a, b, c))
        zero = torch.zeros_like(x)
        opacity = torch.sigmoid(logits[0]) if logits else torch.ones_like(x)
        # Equal depths: the splats are in the order of their rows. The radii are not used.
        columns = [x, y, a, b, c, opacity, zero, zero, red, green, blue, *[zero] * 5]
        return Splats2D(torch.stack(columns, dim=1), None, 3)

    def render(self, scale: float = 1.0) -> Tensor:
        """The image (scale · H, scale · W, 3), rounded; not limited to 0..1; differentiable."""
        size = round(self.width * scale), round(self.height * scale)
        additive = self.blending == "additive"
        return ops.rasterize(self.splats(scale), *size, self.background, additive=additive)[0]
