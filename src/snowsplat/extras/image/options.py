"""`FitOptions`: what one can set of the fit of an image. This module imports nothing slow."""

from dataclasses import dataclass
from typing import Literal

from snowsplat.util.settings import Settings, flag, setting

#: "additive": the image is background + Σ w c, in which the order has no effect and colours may be
#: negative (Zhang et al. 2024, GaussianImage, arXiv:2403.08551). "front-to-back": the Gaussians are
#: composited, the first one in front, as splats are in 3D Gaussian Splatting.
Blending = Literal["additive", "front-to-back"]
#: The largest number of Gaussians of an image.
MOST_GAUSSIANS = 4_000_000


@dataclass(frozen=True)
class FitOptions(Settings):
    """Settings of a fit.

    Attributes:
        seed: on the CPU, the same seed gives the same Gaussians, bit by bit, for any number of
            threads.

    Raises:
        UserError: a value is out of range.
    """

    gaussians: int = flag(
        1000,
        "Number of Gaussians.",
        least=1,
        most=MOST_GAUSSIANS,
        allowed=f"1 to {MOST_GAUSSIANS}",
        aliases=("-n",),
    )
    blending: Blending = setting(
        "front-to-back",
        "front-to-back: opaque to transparent ellipses, the first one in front; additive: the sum "
        "of the Gaussians, without SVG.",
        metavar="{front-to-back,additive}",
    )
    steps: int = flag(
        3000, "Number of steps of the optimiser. More steps give a better image.", least=1
    )
    seed: int = flag(0, "Seed of the random positions of the Gaussians.", "0")
