"""`Transients`: what is in only one photo, such as a person who walks past, does not count.

The scene is static. A thing that moves has another place in each photo, or is in only one of them.
The scene can reproduce it only by fog in front of the camera. So such a thing is masked in its
photo, as by a mask of the user.

That a photo differs from the scene does not tell who is wrong: the scene may not explain this place
yet. So two photos that show the same place must contradict each other, and a third one must agree
with one of them. In units of the noise of these photos (see `view_residuals`), something moves in a
cell if

- its residual is notable;
- most of the photos that show the same place at the same size, and at least two of them, have
  significantly other colours there, and the scene explains them. Things that are thin, shiny or too
  early in the training are wrong in most photos; nobody confirms what one other photo shows;
- the photo does not correlate with the rendering. This is the difference to shadows and gloss on a
  surface, whose detail remains;
- most of the cells around it have these properties, too (patches as in RobustNeRF, Sabour et al.
  2023).

The thing that moves continues over the cells around with a notable residual and without
correlation, unless the other photos are not explained there either. A place that no other photo
shows is never masked without such a beginning: what is not seen twice does not contradict.

If something moves in several photos, the photos are compared again without it, and the noise is
only that of the differences between photos. One other photo is then enough if it agrees with the
scene.

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
from snowsplat.evaluation.metrics import renderings
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.parts.part import Part, PartReport, Section
from snowsplat.training.parts.view_residuals import (
    CellMap,
    Witnesses,
    cell_map,
    cell_size,
    witnesses,
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
#: The residual must be at least this number of its standard deviations in the photo.
_NOTABLE = 2.0
#: This share of the photos that show a place must contradict, and at least this number. Gloss and
#: shadows also change between some of the photos.
_MOST, _FEWEST_OTHERS = 0.75, 2
#: The same surface in another light has at least this correlation with its rendering.
_SAME_DETAIL = 0.5
#: The share of the 3 × 3 cells around a cell that must contradict.
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
        return photo if self._mode == "off" else _masked(photo, self.masks[view.index])

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


class KnownTransients(Part):
    """Masks what moves in the photos of a scene that is already trained."""

    name = "known_transients"

    def begin(self, run: Run) -> None:
        """Compute the masks with the first Gaussians.

        Raises: UserError: a photo is missing or damaged.
        """
        shown = renderings(
            run.gaussians,
            run.dataset.train,
            run.photos,
            run.background.evaluation,
            sh_degree=run.gaussians.sh_degree,
            render=sharded_render(run.shards, with_depth=True),
        )
        maps = [cell_map(each) for each in shown]
        nothing = [torch.zeros_like(cells.usable) for cells in maps]
        self._masks = [~cells.cpu() for cells in _moving_cells(maps, nothing, "on")]

    def target(self, run: Run, view: BatchView, photo: LoadedImage) -> LoadedImage:
        """The photo with the mask of the user and that of what moves."""
        return _masked(photo, self._masks[view.index])


def _masked(photo: LoadedImage, cells: Tensor) -> LoadedImage:
    """The photo, at any size, without the cells, (h, w) bool on the CPU, that are False."""
    if bool(cells.all()):
        return photo
    size = photo.planes.shape[1:]
    cells = cells.to(photo.planes.device, non_blocking=True)
    mask = interpolate(cells[None, None].to(torch.uint8), size)[0, 0].to(torch.bool)
    return replace(photo, mask=mask if photo.mask is None else mask & photo.mask)


def _moving_cells(
    maps: Sequence[CellMap], before: Sequence[Tensor], mode: AutoOnOff
) -> list[Tensor]:
    """The cells (h, w) bool of each map in which something moves; ``before``: of the last time."""

    def found(ignored: Sequence[Tensor], certain: bool) -> list[Tensor]:
        said = witnesses(maps, ignored, certain=certain)
        fewest = _FEWEST_OTHERS if certain else 1
        return [cells_that_move(*each, fewest) for each in zip(maps, said, strict=True)]

    first = found(before, True)
    if _significant(first):
        return found(first, False)
    return [torch.zeros_like(cells) for cells in first] if mode == "auto" else first


def cells_that_move(cells: CellMap, others: Witnesses, fewest: int = _FEWEST_OTHERS) -> Tensor:
    """(h, w) bool: the cells of a view in which something moves, and the cells around them.

    Args:
        others: what the other photos say about these cells.
        fewest: the number of photos that must contradict.
    """
    possible = (cells.residual >= _NOTABLE * cells.noise) & (cells.correlation < _SAME_DETAIL)
    possible &= others.explained >= _MOST * others.others
    contradicted = others.contradicting >= _MOST * others.comparable
    contradicted &= possible & (others.contradicting >= fewest)
    found = contradicted & (_votes(contradicted) >= _VOTES)
    for _ in range(sum(found.shape)):
        more = found | (_dilated(found) & possible)
        if torch.equal(more, found):
            break
        found = more
    return _dilated(found)  # the edge of a thing lies within a cell


def _votes(cells: Tensor) -> Tensor:
    """The share of the 3 × 3 cells around each cell. What is at the border of a photo is assumed to
    continue beyond it.
    """
    planes = pad(cells[None].float(), (1, 1, 1, 1), mode="replicate")
    return avg_pool2d(planes, 3, stride=1)[0]


def _dilated(cells: Tensor) -> Tensor:
    return max_pool2d(cells[None].float(), 3, stride=1, padding=1)[0] > 0.0


def _significant(found: Sequence[Tensor]) -> bool:
    """Whether something moves in several photos."""
    photos = sum(float(cells.float().mean()) >= _SHARE for cells in found)
    return photos >= max(_PHOTOS, _PHOTOS_SHARE * len(found))
