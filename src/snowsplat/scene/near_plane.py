"""The near plane: relative to the scene, because the unit of a scene is not ours to choose.

Gaussians nearer than the near plane are not drawn: their projections would be huge, and the linear
approximation of EWA splatting does not hold there. The implementation of the paper uses 0.2 world
units. In the unit of COLMAP, a scene is usually 3 to 5 units away; in metres, it may be 0.3 units
or 300. So the near plane is 0.2 · 2ᵏ, where 2ᵏ is about the distance of the scene divided by the
usual distance. Thus usual scenes have the near plane of the paper, and a scene that is scaled by a
power of two has the same images.
"""

from __future__ import annotations

import math

#: The near plane of the implementation of the paper, in world units.
NEAR = 0.2
# The distance of scenes for which `NEAR` is used is between this and twice this, in world units.
_USUAL_DISTANCE = 2.8
# What is nearer than nearly everything is at least this many times as far as the near plane.
_NEAREST = 3.0

# For a scene whose cameras are not known, relative to the distance of its middle.
_OF_DISTANCE = 0.05


def near_of_overview(distance: float) -> float:
    """The near plane of a camera that shows a scene from ``distance``, in world units.

    Such a scene is rendered as it is, so no compatibility with a training asks for `NEAR`.
    """
    return _OF_DISTANCE * distance if 0 < distance < math.inf else NEAR


def near_plane(distance: float, nearest: float | None = None) -> float:
    """The depth below which no Gaussian is drawn, in world units.

    Args:
        distance: the usual depth of what the cameras see, in world units, > 0.
        nearest: the depth that nearly everything exceeds, if it is known.
    """
    ratio = distance / _USUAL_DISTANCE
    if nearest is not None:
        ratio = min(ratio, nearest / (_NEAREST * NEAR))
    return math.ldexp(NEAR, math.floor(math.log2(ratio))) if 0 < ratio < math.inf else NEAR
