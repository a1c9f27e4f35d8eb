"""What the sliders of the page can hide: Gaussians far from the subject, and large Gaussians.

In places that no photo shows, a trained scene has Gaussians that are much larger than those of the
surfaces. `hiding.js` hides Gaussians by distance and by size while they are copied for the
drawing; the scene itself is not changed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from snowsplat.scene.gaussians import Gaussians

#: The sliders begin at this quantile of the distances and sizes: what is beyond goes first.
_MOST = 0.999
#: The smallest distance and size that are kept, relative to the radius of the subject.
_NEAREST, _SMALLEST = 0.25, 0.03
# Without cameras, what is larger than this, relative to the radius, is hidden at first; but at most
# this share of the Gaussians.
_FLOATER, _FEW = 0.1, 0.02
_ROWS_SAMPLED = 1_000_000


@dataclass(frozen=True)
class Hiding:
    """The ranges of the sliders, in world units."""

    # From the subject; what a value just above 0 keeps, and what 100 keeps.
    distance: tuple[float, float]
    size: tuple[float, float]  # of the longest axis of a Gaussian, in standard deviations; likewise
    start: int  # the value for the size at first

    def settings(self) -> dict[str, Any]:
        """What `hiding.js` needs."""
        return {"distance": self.distance, "size": self.size, "start": [0, self.start]}

    def shown(self, gaussians: Gaussians) -> Gaussians:
        """What the page shows at first."""
        if not self.start:
            return gaussians
        largest, least = self.size
        return gaussians.select(
            _sizes(gaussians) <= largest * (least / largest) ** (self.start / 100)
        )


def hiding_of(gaussians: Gaussians, middle: Tensor, radius: float, *, hide: bool) -> Hiding:
    """The ranges for a scene, whose subject has the ``middle`` (3,) and the ``radius``.

    ``hide``: hide floaters at first.
    """
    rows = slice(None, None, -(-len(gaussians) // _ROWS_SAMPLED) or 1)
    distances = (gaussians.means.detach()[rows].double().cpu() - middle).norm(dim=1)
    sizes = _sizes(gaussians)[rows].double().cpu()
    near, small = _NEAREST * radius, _SMALLEST * radius
    # Ranges of at least a factor of 2 have no steps.
    far = max(_quantile(distances, _MOST), 2 * near)
    largest = max(_quantile(sizes, _MOST), 2 * small)
    floater = max(_FLOATER * radius, _quantile(sizes, 1 - _FEW))
    start = 100 * math.log(floater / largest) / math.log(small / largest) if hide else 0.0
    return Hiding((far, near), (largest, small), max(0, math.floor(start)))


def _sizes(gaussians: Gaussians) -> Tensor:
    """(N,) the longest axes."""
    return gaussians.log_scales.detach().amax(1).exp()


def _quantile(values: Tensor, share: float) -> float:
    values = values[values.isfinite()]
    return float(values.quantile(share)) if len(values) else 0.0
