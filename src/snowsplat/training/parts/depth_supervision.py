"""`DepthSupervision`: the depths of the scene agree with the depth maps of the dataset.

Photos leave the depth of a wall of one colour open; a depth sensor, stereo or a network measures
it. Each map is aligned to the points of the dataset, as for the start `depth`. The loss compares
inverse depths, as networks and stereo measure them: with the residual r = (d − s · d_map) / d_mid,
where d = alpha / depth is that of the rendering and d_mid the median of the map, it is the mean of

    c · log(1 + |r| / c),  c = 0.03

over the pixels with a depth (Cauchy's idea of a robust loss, with a constant slope at 0): a small
residual counts like |r|, and the pull of a large one falls like 1 / |r|. So a part of a map that is
wrong, for example at an edge or in a mirror, is outvoted by the photos.

The scale s is fitted in each step to the rendering, within a few percent of 1: a few points do not
tell the scale of a map more exactly. A map that contradicts the scene as one of another photo would
is not used any more (`CHECK_FROM`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from snowsplat.scene.render import RenderOutput
from snowsplat.training.parts.part import Part
from snowsplat.training.starts.depth import aligned_depth_map, contradicts
from snowsplat.training.starts.depth_map import LONGER_SIDE
from snowsplat.training.step.batch import Batch, BatchView
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.util.names import first_names

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: c: the residual, relative to the median inverse depth, at which a pixel has half the pull.
_RESIDUAL = 0.03
#: The fitted scale is 1 ± this.
_SCALE_RANGE = 0.05
#: All maps together have at most this number of pixels, of two bytes; with more photos, they are
#: smaller.
_MOST_PIXELS = 32_000_000
#: Maps are compared with the scene after this share of the steps, every `INTERVAL` steps. Before,
#: the scene may be wrong.
CHECK_FROM, INTERVAL = 0.4, 100


class DepthSupervision(Part):
    """The loss of the depth maps, ``weight`` times.

    Attributes:
        errors: (V,) float32 on the device: the median of |r| of each training view when it was last
            used; -1: not yet.
        used: (V,) bool on the CPU: the views whose map is used.
    """

    name = "depth"

    def __init__(self, weight: float) -> None:
        self.weight = weight
        # () errors of the views of this process in the present step.
        self._present: dict[BatchView, Tensor] = {}

    def prepare(self, run: Run) -> None:
        """Read and align the maps. One that is damaged or contradicts the points is left out."""
        views = run.dataset.train
        given = sum(view.depth is not None for view in views)
        points = None if run.dataset.points is None else run.dataset.points.xyz.cpu()
        side = min(LONGER_SIDE, int(math.sqrt(_MOST_PIXELS / max(given, 1))))
        self._maps: dict[int, Tensor] = {}  # (h, w) float16: d_map / d_mid; 0: unknown
        self._middles: dict[int, float] = {}  # d_mid, in 1 / world units
        self._spreads: dict[int, float] = {}
        damaged: UserError | None = None
        for index, view in enumerate(views):
            try:
                found = aligned_depth_map(view, run.images, points, side)
            except UserError as error:
                damaged = damaged or error
                continue
            if found is None or not bool((found.inverse_depth > 0).any()):
                continue
            known = found.inverse_depth[found.inverse_depth > 0]
            middle = float(known.median())
            self._middles[index] = middle
            self._spreads[index] = float((known / middle - 1.0).abs().median())
            self._maps[index] = (found.inverse_depth / middle).to(run.device, torch.float16)
        self.used = torch.tensor([index in self._maps for index in range(len(views))])
        self.errors = torch.full((len(views),), -1.0, device=run.device)
        self.with_depth = bool(self._maps)
        self.idle = not self._maps
        if given:
            unused = given - len(self._maps)
            note = message(
                "depth maps: {maps} of {views} photos", maps=len(self._maps), views=len(views)
            )
            if damaged:
                note = message("{note}; {damaged}", note=note, damaged=damaged)
            elif unused:
                note = message(
                    "{note}; {unused} contradict the points or show too few of them",
                    note=note,
                    unused=unused,
                )
            run.note(note)
        elif not any(view.normals for view in views):
            run.note(
                message(
                    "depth maps: no photo has one, so depth_weight has no effect; add them as "
                    "depths/IMG.png for the photo IMG.jpg, or normals/IMG.png (PNG, TIFF, NPY or "
                    "EXR)"
                )
            )

    def loss(self, run: Run, view: BatchView, rendered: RenderOutput) -> Tensor | None:
        """See the module. Each rendering has at most as many pixels as the map."""
        if not self.used[view.index]:
            return None
        assert rendered.depth is not None
        target = self._maps[view.index]
        size = [min(a, b) for a, b in zip(rendered.alpha.shape, target.shape, strict=True)]
        depth, alpha, target = (
            _resampled(values, size) for values in (rendered.depth, rendered.alpha, target)
        )
        term, error = depth_term(depth, alpha, target, self._middles[view.index])
        self._present[view] = error  # if a step is repeated, this replaces that of the last attempt
        return self.weight * term

    def after_step(self, run: Run, step: int, batch: Batch) -> None:
        """Keep the errors of the batch, in every process."""
        if self.idle:
            return
        size, rank = run.shards.size, run.shards.rank
        own = self.errors.new_full((-(-len(batch) // size),), -1.0)
        for row, view in enumerate(batch[rank::size]):  # in each round, process r has view r
            if view in self._present:
                own[row] = self._present[view]
        self._present.clear()
        table = run.shards.table(own)
        for position, view in enumerate(batch):
            self.errors[view.index] = table[position % size, position // size]

    def between(self, run: Run) -> None:
        """Find the maps that contradict the scene, in every `INTERVAL`-th step."""
        begun = run.step >= run.schedule.step_of(CHECK_FROM)
        if self.idle or not begun or not run.schedule.multiples(run.step, INTERVAL):
            return
        errors = self.errors.tolist()
        wrong = [
            index
            for index, spread in self._spreads.items()
            if self.used[index] and contradicts(errors[index], spread)
        ]
        if wrong:
            self.used[wrong] = False
            names = first_names([run.dataset.train[index].name for index in wrong], 5)
            run.note(
                message(
                    "depth maps that contradict the photos are not used any more: {names}",
                    names=names,
                )
            )

    def state(self) -> dict[str, Tensor]:
        """See `Part`."""
        return {"errors": self.errors, "used": self.used}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """See `Part`."""
        self.errors.copy_(tensors["errors"])
        self.used = tensors["used"].cpu() & self.used


def depth_term(
    depth: Tensor, alpha: Tensor, target: Tensor, middle: float
) -> tuple[Tensor, Tensor]:
    """The mean loss () of a view, differentiable in ``depth`` and ``alpha``, and the median of |r|.

    Pixels of little alpha count less: they show the background.

    Args:
        depth: (H, W) Σ T α z in world units.
        alpha: (H, W) in 0..1.
        target: (H, W) d_map / d_mid; 0: unknown.
        middle: d_mid in 1 / world units.
    """
    target = target.to(depth.dtype)
    weight = (target > 0) * alpha.detach()
    nearest = torch.finfo(depth.dtype).eps
    d = alpha / (middle * depth).clamp_min(nearest)
    with torch.no_grad():
        trust = weight / (1.0 + ((d - target) / _RESIDUAL).square())
        scale = (trust * d * target).sum() / (trust * target.square()).sum().clamp_min(nearest)
        target = scale.clamp(1.0 - _SCALE_RANGE, 1.0 + _SCALE_RANGE) * target
    r = (d - target).abs()
    term = _RESIDUAL * (weight * (r / _RESIDUAL).log1p()).sum() / d.numel()
    shown = torch.where(weight > 0.5, r.detach(), torch.nan)
    return term, shown.nanmedian().nan_to_num(nan=-1.0)


def _resampled(values: Tensor, size: list[int]) -> Tensor:
    """(H, W) at another size, by the nearest pixel; a mean would mix two surfaces at edges."""
    if list(values.shape) == size:
        return values
    return interpolate(values[None, None], size, mode="nearest-exact")[0, 0]
