"""`position_findings`: whether camera positions differ, and are near enough to the origin."""

from __future__ import annotations

import numpy as np

from snowsplat.data.judge.finding import Finding
from snowsplat.data.judge.rig import Rig

# Distance of the scene from the origin, relative to the extent of the cameras. Kernels compute in
# float32, with a relative error of 6e-8. At a distance of 2000 extents this is a tenth of a pixel
# of a photo with 1000 pixels; at 50,000 it is some pixels.
_ROUNDED, _LOST = 2e3, 5e4


def position_findings(rig: Rig) -> list[Finding]:
    """What is impossible or doubtful about the positions of cameras, whatever the scene is."""
    positions = rig.positions
    if len(positions) < 2:
        return []
    middle = positions.mean(0)
    extent = float(np.linalg.norm(positions - middle, axis=1).max())
    distance = float(np.linalg.norm(middle))
    # Positions are computed from rotations and translations, with rounding errors.
    if extent <= 1e-9 * max(distance, np.abs(rig.translation).max(), 1e-30):
        text = f"all {len(rig)} cameras are at one place, so the photos show no depth"
        return [Finding("positions", text)]
    if distance > _ROUNDED * extent:
        text = (
            f"the cameras are {distance:,.0f} units away from the origin, and {extent:.3g} from "
            f"each other, which 32-bit numbers cannot resolve; subtract "
            f"({', '.join(f'{value:.0f}' for value in middle)}) from the positions of cameras and "
            "points"
        )
        return [Finding("origin", text, impossible=distance > _LOST * extent)]
    return []
