"""`SkyPart`: the first Gaussians include some for the sky, and none is before it.

See `found_sky` for how the sky is found.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from snowsplat.data.dataset import Points
from snowsplat.training.parts.found_sky import Sky, find_sky
from snowsplat.training.parts.part import REMOVED, Part
from snowsplat.training.starts.init import most_sky_points
from snowsplat.util.messages import message
from snowsplat.util.process import single_threaded

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: Number of steps between two applications.
INTERVAL = 200
#: Gaussians that are processed at a time, on a CPU (for its cache) and on a GPU (for its memory).
_ROWS, _ROWS_OF_GPU = 1 << 14, 1 << 20


class SkyPart(Part):
    """Adds points in the sky, and removes Gaussians before it. It has no state.

    Attributes:
        sky: where the photos show the sky; None: they do not, or the training starts from given
            Gaussians.
    """

    name = "sky"

    def __init__(self, distance: float = 0.0) -> None:
        """
        ``distance``: of the sky from the middle of the cameras, in world units; 0: `sky_distance`.
        """
        self.distance = distance
        self.sky: Sky | None = None
        self._decided = False

    def prepare(self, run: Run) -> None:
        """Find the sky in the photos, unless a state follows, which may correct the photos.

        Raises: UserError: a photo is missing or damaged.
        """
        self._decided = not run.resumed
        if not run.resumed and run.initial is None:
            self._find(run)

    def _find(self, run: Run) -> None:
        with single_threaded():
            found = find_sky(run.dataset, run.photos, self.distance)
        if found is not None:
            share = 100 * found.share
            run.note(
                message(
                    "the photos show the sky ({share:.0f}% of them): the training starts with it",
                    share=share,
                )
            )
            self.sky = found

    def points(self, run: Run, points: Points) -> Points:
        """The points that are not before the sky, and points in it."""
        if self.sky is None:
            return points
        far = self.sky.points(most_sky_points(run.config.points_per_start), run.background.fixed)
        kept = ~self.sky.is_before(points.xyz.to(run.device)).cpu()
        return Points(
            torch.cat([points.xyz[kept], far.xyz]), torch.cat([points.rgb[kept], far.rgb])
        )

    def between(self, run: Run) -> None:
        """Make Gaussians before the sky transparent, in place, in every `INTERVAL`-th step."""
        if not self._decided:
            self._decided = True
            self._find(run)
        if self.sky is not None and run.schedule.multiples(run.step, INTERVAL):
            means = run.gaussians.means
            rows = _ROWS if means.device.type == "cpu" else _ROWS_OF_GPU
            before = [self.sky.is_before(part) for part in means.split(rows)]
            run.gaussians.opacity_logits.masked_fill_(torch.cat(before), REMOVED)
