"""Procedural scenes that are built quickly: most of the time is spent on their light."""

import pytest

from snowsplat.synthetic import scene, still_life


def coarse_light(patch: pytest.MonkeyPatch, spacing: float = 0.1) -> None:
    """Light at fewer points, ``spacing`` metres apart."""
    patch.setattr(scene, "_SPACING", spacing)
    patch.setattr(scene, "_MOST_POINTS", 12)


def coarse_still_life(patch: pytest.MonkeyPatch, texel: float = 4.0) -> None:
    """Also texels that are ``texel`` times as large, for small photos."""
    size = still_life._size
    patch.setattr(still_life, "_size", lambda metres, each: size(metres, texel * each))
    coarse_light(patch)
