"""`Transients`: what is in only one photo, such as a person who walks past, does not count.

The scene is static. A thing that moves has another place in each photo, or is in only one of them.
The scene can reproduce it only by fog in front of the camera. So such a thing is masked in its
photo, as by a mask of the user. It is found by four properties:

- the residual of its cells is large (see `view_residuals`);
- the residuals of the same places in other photos are small. This is the difference to what the
  scene does not explain yet, such as thin or shiny things: they are wrong in most photos;
- the photo does not correlate with the rendering. This is the difference to shadows and gloss on a
  surface, whose detail remains;
- most of the cells around it have these properties, too (patches as in RobustNeRF, Sabour et al.
  2023).

If several photos have such a thing, smaller residuals are enough, and the photos are compared again
without it. Then places that only one other photo shows are judged, too, and those that no other
photo shows, by their own photo.

The masks are computed anew at a few moments. A place that is masked by mistake is still trained by
the other photos, so it is not masked the next time. As in RobustSplat (Fu et al. 2025), Gaussians
are added only after the first masks, if the part is always on: many Gaussians would reproduce what
moves before it is found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pad

from snowsplat.data.photos.decode import LoadedImage
from snowsplat.evaluation.renderings import renderings
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.parts.part import Part
from snowsplat.training.parts.part_report import PartReport, Section
from snowsplat.training.parts.view_residuals import (
    CellMap,
    cell_map,
    cell_size,
    residuals_elsewhere,
)
from snowsplat.training.processes.shards import sharded_render
from snowsplat.training.settings.config import AutoOnOff
from snowsplat.training.step.batch import BatchView
from snowsplat.util.messages import message

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: When masks are computed, as fractions of the schedule.
MOMENTS = (0.1, 0.2, 0.3, 0.4)
#: With fewer views, nothing is masked: too few of them show the same place. With few views, much of
#: the background is in one photo only, and the depth of its rendering is wrong.
_FEWEST_VIEWS = {"auto": 30, "on": 8, "off": 0}
#: With "auto", and with fewer steps for each view, the comparisons would take too much of the time.
_STEPS_PER_VIEW = 8
#: With "auto", if nothing moves after this moment, the photos are not compared again.
_NOTHING = MOMENTS[1]
#: The residual of a cell is large if it is at least this, and at least this many times one of two
#: quantiles of the residuals of all cells. Early in the training, all residuals are larger. If what
#: moves covers more than a tenth of the photos, the higher quantile is a residual of it, but the
#: median is not.
_LARGE, _TIMES_QUANTILE = 0.1, ((2.0, 0.9), (4.0, 0.5))
#: Around cells with a large residual, this share of it is enough, up to this number of cells away.
_NOTABLE, _RINGS = 0.5, 3
#: If something moves in several photos, this share of a large residual is enough.
_LESS = 0.8
#: It must be this many times the residual of the same place in other views, ...
_TIMES = 3.0
#: ... of which there must be at least this number. If something moves in several photos, one other
#: view is enough, and with none the photo is judged alone.
_FEWEST_OTHERS = 2
#: The same surface in another light has at least this correlation with its rendering.
_SAME_DETAIL = 0.5
#: The share of the 3 × 3 cells around a cell that must have a large residual.
_VOTES = 0.5
#: With "auto", a photo counts if this share of its cells are found. Things move in the scene if at
#: least this number of photos and this share of all photos count.
_SHARE, _PHOTOS, _PHOTOS_SHARE = 0.02, 3, 0.1


class Transients(Part):
    """The masks of what moves, computed between the steps of a training run.

    Attributes:
        masks: for each view, (h, w) bool on the CPU, one value for each cell of `view_residuals`:
            False where something moves.
    """

    name = "transients"

    def __init__(self, mode: AutoOnOff) -> None:
        """
        ``mode``: "auto": only if something moves in several photos; see ``TrainConfig.transients``.
        """
        self.mode = self._mode = mode
        self._run: Run
        self.masks: list[Tensor] = []

    def begin(self, run: Run) -> None:
        """Begin with empty masks, and decide whether there are enough photos and steps."""
        self._run, views = run, run.dataset.train
        self.masks = [torch.ones(cell_size(view.camera), dtype=torch.bool) for view in views]
        # The schedule of a resumed training run may be shorter than at its beginning.
        few_steps = run.config.iterations < _STEPS_PER_VIEW * len(views)
        self._mode = self.mode
        if (self._mode == "auto" and few_steps) or len(views) < _FEWEST_VIEWS[self._mode]:
            self._mode = "off"

    def between(self, run: Run) -> None:
        """Compute the masks, after the steps of `MOMENTS`.

        Raises: UserError: a photo is missing or damaged.
        """
        moments = [run.schedule.step_of(moment) for moment in MOMENTS]
        if self._mode == "off" or not run.schedule.contains(run.step, moments):
            return
        late = run.step > run.schedule.step_of(_NOTHING)
        if self._mode == "auto" and late and not self.shares():
            return
        self._compute(run)
        if run.step >= moments[-1]:
            self._note()
        run.queue.continue_with(run.queue.order, run.step)

    def _compute(self, run: Run) -> None:
        views = run.dataset.train
        used = [i for i in range(len(views)) if i not in run.excluded]
        # At the size of the training: Gaussians that were trained on larger photos are too small
        # for reduced ones, and their rendering is too bright or too dark.
        shown = renderings(
            run.gaussians,
            [views[i] for i in used],
            run.photos,
            run.background.evaluation,
            downscale=run.downscale_at(run.step),
            sh_degree=run.sh_degree,
            render=sharded_render(run.shards, with_depth=True),
        )
        maps = [cell_map(each) for each in shown]
        found = _moving_cells(maps, [~self.masks[i].to(run.device) for i in used], self._mode)
        for i, cells in zip(used, found, strict=True):
            self.masks[i] = ~cells.cpu()

    def target(self, run: Run, view: BatchView, photo: LoadedImage) -> LoadedImage:
        """The photo, at any size, with the mask of the user and that of what moves."""
        cells = self.masks[view.index]
        if self._mode == "off" or bool(cells.all()):
            return photo
        size = photo.planes.shape[1:]
        cells = cells.to(photo.planes.device, non_blocking=True)
        mask = interpolate(cells[None, None].to(torch.uint8), size)[0, 0].to(torch.bool)
        return replace(photo, mask=mask if photo.mask is None else mask & photo.mask)

    def shares(self) -> dict[str, float]:
        """The masked share of the photo, by the name of each view in which something moves."""
        views = zip(self._run.dataset.train, self.masks, strict=True)
        shares = {view.name: 1.0 - float(mask.float().mean()) for view, mask in views}
        return {name: share for name, share in shares.items() if share > 0.0}

    def pictures(self) -> dict[str, Image.Image]:
        """The masks of these views by name, of the size of the photo: 0 where something moves."""
        return {
            view.name: Image.fromarray((255 * mask.numpy()).astype(np.uint8)).resize(
                (view.camera.width, view.camera.height), Image.Resampling.NEAREST
            )
            for view, mask in zip(self._run.dataset.train, self.masks, strict=True)
            if not bool(mask.all())
        }

    def report(self, run: Run, gaussians: Gaussians) -> PartReport:
        """The masks, and the masked share of each photo that has one."""
        masks = self.pictures()
        if not masks:
            return PartReport()
        text = message(
            "In {some} of {all} photos, something looks different from what the other photos show "
            "at this place, for example a person who walks past.",
            some=len(masks),
            all=len(self.masks),
        )
        unused = message("The tinted parts were not used for training.")
        return PartReport(
            files={f"masks/{name}.png": mask for name, mask in masks.items()},
            sections=(Section(message("What moves"), (text, unused), masks=masks),),
            facts=self.shares(),
        )

    def _note(self) -> None:
        shares, photos = self.shares().values(), len(self.masks)
        if shares:
            mean = 100.0 * sum(shares) / len(shares)
            self._run.note(
                message(
                    "something moves in {shares} of {photos} photos: masked there, {mean:.1f}% "
                    "of their pixels; see the report",
                    shares=len(shares),
                    photos=photos,
                    mean=mean,
                )
            )

    def state(self) -> dict[str, Tensor]:
        """The masks, one after the other."""
        return {"masks": torch.cat([mask.flatten() for mask in self.masks])}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """See `Part.load`."""
        counts = [mask.numel() for mask in self.masks]
        parts = tensors["masks"].split(counts)
        self.masks = [
            part.clone().reshape(mask.shape) for part, mask in zip(parts, self.masks, strict=True)
        ]
        if self.shares():
            self._mode = self.mode
        if self._run.step > self._run.schedule.step_of(MOMENTS[-1]):
            self._note()


def _moving_cells(
    maps: Sequence[CellMap], before: Sequence[Tensor], mode: AutoOnOff
) -> list[Tensor]:
    """The cells (h, w) bool of each map in which something moves; ``before``: of the last time."""
    large = large_residual([cells.residual for cells in maps])

    def found(ignored: Sequence[Tensor], large: float, alone: bool) -> list[Tensor]:
        return [
            cells_that_move(cells, *elsewhere, large, last, alone)
            for cells, elsewhere, last in zip(
                maps, residuals_elsewhere(maps, ignored), before, strict=True
            )
        ]

    first = found(before, large, False)
    if _significant(first):
        return found(first, _LESS * large, True)
    return [torch.zeros_like(cells) for cells in first] if mode == "auto" else first


def cells_that_move(
    cells: CellMap, elsewhere: Tensor, others: Tensor, large: float, before: Tensor, alone: bool
) -> Tensor:
    """(h, w) bool: the cells in which something moves, and the cells around them.

    Args:
        cells: those of a view.
        elsewhere: (h, w), the residual of their places in other views; see `residuals_elsewhere`.
        others: (h, w), the number of these views.
        large: the smallest large residual.
        before: (h, w) bool, the result of the last time.
        alone: whether places that one or no other view shows can be found, too.
    """
    large_here = cells.residual >= large
    differs = cells.correlation < _SAME_DETAIL
    judged = others >= (1 if alone else _FEWEST_OTHERS)
    stands_out = judged & differs & (cells.residual >= _TIMES * elsewhere)
    unknown = ~judged & differs & (cells.places.inverse_depth > 0.0) & large_here
    confirmed = stands_out & large_here
    likely = confirmed | unknown if alone else confirmed
    found = likely & (_votes(likely) >= _VOTES)
    # Other photos need not confirm the cells around, but must not contradict.
    notable = (stands_out & (cells.residual >= _NOTABLE * large)) | unknown
    found |= before & notable
    for _ in range(_RINGS):
        found |= _dilated(found) & notable
    return _dilated(found)  # the edge of a thing lies within a cell


def _votes(cells: Tensor) -> Tensor:
    """The share of the 3 × 3 cells around each cell. What is at the border of a photo is assumed to
    continue beyond it.
    """
    planes = pad(cells[None].float(), (1, 1, 1, 1), mode="replicate")
    return avg_pool2d(planes, 3, stride=1)[0]


def _dilated(cells: Tensor) -> Tensor:
    return max_pool2d(cells[None].float(), 3, stride=1, padding=1)[0] > 0.0


def large_residual(residuals: Sequence[Tensor]) -> float:
    """The smallest large residual, for the residuals of the cells of all views."""
    every = torch.cat([residual.flatten() for residual in residuals]).cpu()

    def quantile(share: float) -> float:
        return float(every.kthvalue(round(share * (len(every) - 1)) + 1).values)

    return max(_LARGE, min(times * quantile(share) for times, share in _TIMES_QUANTILE))


def _significant(found: Sequence[Tensor]) -> bool:
    """Whether something moves in several photos."""
    photos = sum(float(cells.float().mean()) >= _SHARE for cells in found)
    return photos >= max(_PHOTOS, _PHOTOS_SHARE * len(found))
