"""The Gaussians as a picture in the format SVG: one ellipse with a radial gradient for each."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from snowsplat.extras.image.model import (
    ANGLE,
    COLORS,
    LOG_SIGMAS,
    MEANS,
    OPACITY_LOGIT,
    ImageGaussians,
)
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_text

# The ellipse ends where the opacity of a Gaussian with opacity 1 is 1/255, as in the rasterizer.
_CUTOFF = math.sqrt(2 * math.log(255))  # σ
# Stops of a gradient. Between two of them, the opacity is linear.
_STOPS = 9


def write_svg(path: Path, gaussians: ImageGaussians) -> None:
    """Write the Gaussians as an SVG file, atomically.

    SVG composites shapes from back to front, which is front-to-back blending in the opposite order.
    Colours are limited to 0..1 and rounded to 8 bits, and a gradient is piecewise linear, so the
    picture differs slightly from `ImageGaussians.render`.

    Raises:
        UserError: the Gaussians are additive. SVG has no negative colours.
        OSError: the file cannot be written.
    """
    if gaussians.blending == "additive":
        raise UserError("additive Gaussians have no SVG; fit the photo with blending front-to-back")
    write_text(path, "".join(_lines(gaussians)))


@torch.no_grad()
def _lines(gaussians: ImageGaussians) -> Iterator[str]:
    width, height = gaussians.width, gaussians.height
    yield (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}">\n'
        # A gradient inherits its colour from the attribute `color`.
        "<style>stop{stop-color:currentColor}</style>\n"
        f'<rect width="{width}" height="{height}" fill="{_hex(gaussians.background.numpy())}"/>\n'
    )
    rows = gaussians.rows.flip(0).double()
    means, angles = rows[:, MEANS].numpy(), rows[:, ANGLE].rad2deg().numpy()
    radii = _CUTOFF * rows[:, LOG_SIGMAS].exp().numpy()
    colors = rows[:, COLORS].numpy()
    opacities = torch.sigmoid(rows[:, OPACITY_LOGIT]).numpy()
    offsets = np.linspace(0, 1, _STOPS)
    falloff = np.exp(-0.5 * (_CUTOFF * offsets) ** 2)
    falloff[-1] = 0.0
    for i in range(len(rows)):
        stops = "".join(
            f'<stop offset="{offset:.3g}" stop-opacity="{opacities[i] * weight:.3g}"/>'
            for offset, weight in zip(offsets, falloff, strict=True)
        )
        (x, y), (rx, ry) = means[i], radii[i]
        yield (
            f'<radialGradient id="g{i}" color="{_hex(colors[i])}">{stops}</radialGradient>\n'
            f'<ellipse rx="{rx:.2f}" ry="{ry:.2f}" fill="url(#g{i})" '
            f'transform="translate({x:.2f} {y:.2f}) rotate({angles[i] % 180:.1f})"/>\n'
        )
    yield "</svg>\n"


def _hex(color: np.ndarray) -> str:
    """(3,) in 0..1 as #rrggbb."""
    return "#" + bytes(np.rint(np.clip(color, 0, 1) * 255).astype(np.uint8)).hex()
