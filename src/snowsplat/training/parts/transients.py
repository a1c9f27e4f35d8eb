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

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pad

from snowsplat import ops
from snowsplat.data.dataset import View
from snowsplat.data.decode import LoadedImage
from snowsplat.data.image_loader import Photos
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import project
from snowsplat.training.core.step_schedule import Schedule
from snowsplat.training.density import DensityConfig
from snowsplat.training.parts.view_residuals import (
    CellMap,
    cell_map,
    cell_size,
    residuals_elsewhere,
)
from snowsplat.training.processes.shards import Shards

TransientsMode = Literal["auto", "on", "off"]

#: When masks are computed, as fractions of the schedule.
MOMENTS = (0.1, 0.2, 0.3, 0.4)
#: With "on", the first moment at which Gaussians are added.
_GROWTH = MOMENTS[1]
#: With fewer views, nothing is masked: too few of them show the same place. With few views, much of
#: the background is in one photo only, and the depth of its rendering is wrong.
_FEWEST_VIEWS = {"auto": 30, "on": 8, "off": 0}
#: With "auto", and with fewer steps for each view, the comparisons would take too much of the time.
_STEPS_PER_VIEW = 8
#: With "auto", if nothing moves after this moment, the photos are not compared again.
_NOTHING = MOMENTS[1]
#: The residual of a cell is large if it is at least this, and at least this many times the quantile
#: of the residuals of all cells. Early in the training, all residuals are larger.
_LARGE, _LARGE_TIMES, _QUANTILE = 0.1, 2.0, 0.9
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


class Transients:
    """The masks of what moves, computed between the steps of a training run.

    Attributes:
        masks: for each view, (h, w) bool on the CPU, one value for each cell of `view_residuals`:
            False where something moves.
    """

    def __init__(
        self,
        mode: TransientsMode,
        views: Sequence[View],
        images: Photos,
        background: Tensor,
        schedule: Schedule,
        shards: Shards,
    ) -> None:
        """
        Args:
            mode: "auto": only if something moves in several photos; see ``TrainConfig.transients``.
            views: the training views.
            images: their photos.
            background: (3,) colour in 0..1, on the device of the Gaussians.
        """
        self._mode, self._views, self._images = mode, views, images
        self._background, self._schedule, self._shards = background, schedule, shards
        self.masks = [torch.ones(cell_size(view.camera), dtype=torch.bool) for view in views]
        costly = mode == "auto" and schedule.iterations < _STEPS_PER_VIEW * len(views)
        if costly or len(views) < _FEWEST_VIEWS[mode]:
            self._mode = "off"

    def after_step(
        self,
        step: int,
        gaussians: Gaussians,
        sh_degree: int,
        downscale: int,
        left_out: Collection[int],
    ) -> bool:
        """Compute the masks, after the steps of `MOMENTS`; whether this was such a step.

        Args:
            sh_degree: degree of the spherical harmonics in use.
            downscale: the factor by which the photos of the step are reduced.
            left_out: indices of views that are not used.

        Raises:
            UserError: a photo is missing or damaged.
        """
        moments = [self._schedule.step_of(moment) for moment in MOMENTS]
        if self._mode == "off" or not self._schedule.contains(step, moments):
            return False
        late = step > self._schedule.step_of(_NOTHING)
        if self._mode == "auto" and late and not self.found:
            return False

        def with_depth(camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
            camera = camera.to(gaussians.means.device)
            splats = self._shards.everywhere(project(gaussians, camera, sh_degree))
            size = camera.width, camera.height
            image, alpha, depth = ops.rasterize(splats, *size, self._background, with_depth=True)
            assert depth is not None
            return image, alpha, depth

        used = [i for i in range(len(self._views)) if i not in left_out]
        self._images.prefetch([self._views[i] for i in used], downscale)
        maps = []
        for i in used:
            view = self._views[i]
            photo = self._images.get(view, downscale)
            maps.append(cell_map(view.camera, photo, downscale, self._background, with_depth))
        found = _moving_cells(maps, [~self.masks[i] for i in used], self._mode)
        for i, cells in zip(used, found, strict=True):
            self.masks[i] = ~cells
        return True

    def masked(self, view: int, photo: LoadedImage) -> LoadedImage:
        """The photo of a view, at any size, with the mask of the user and that of what moves."""
        cells = self.masks[view]
        if self._mode == "off" or bool(cells.all()):
            return photo
        size = photo.planes.shape[1:]
        mask = interpolate(cells[None, None].to(torch.uint8), size)[0, 0].to(torch.bool)
        mask = mask.to(photo.planes.device)
        return replace(photo, mask=mask if photo.mask is None else mask & photo.mask)

    def complete(self, step: int) -> bool:
        """Whether the masks do not change any more after ``step``."""
        return self._mode == "off" or step > self._schedule.step_of(MOMENTS[-1])

    @property
    def found(self) -> dict[int, float]:
        """The masked share of the photo, by the index of each view in which something moves."""
        shares = {i: 1.0 - float(mask.float().mean()) for i, mask in enumerate(self.masks)}
        return {i: share for i, share in shares.items() if share > 0.0}

    def pictures(self) -> dict[str, Image.Image]:
        """The masks of these views by name, of the size of the photo: 0 where something moves."""
        return {
            self._views[i].name: Image.fromarray(
                (255 * self.masks[i].numpy()).astype(np.uint8)
            ).resize(
                (self._views[i].camera.width, self._views[i].camera.height),
                Image.Resampling.NEAREST,
            )
            for i in self.found
        }

    def state_tensors(self) -> dict[str, Tensor]:
        """The masks, one after the other."""
        return {"masks": torch.cat([mask.flatten() for mask in self.masks])}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Replace the masks by those of `state_tensors`."""
        counts = [mask.numel() for mask in self.masks]
        parts = tensors["masks"].split(counts)
        self.masks = [
            part.clone().reshape(mask.shape) for part, mask in zip(parts, self.masks, strict=True)
        ]


def delayed(density: DensityConfig) -> DensityConfig:
    """The density control that adds no Gaussians before the masks are known."""
    begin = density.densify_from
    # A number of steps is that of a long schedule, whose first masks are later.
    late = not isinstance(begin, float) or begin < _GROWTH
    return replace(density, densify_from=_GROWTH) if late else density


def _moving_cells(
    maps: Sequence[CellMap], before: Sequence[Tensor], mode: TransientsMode
) -> list[Tensor]:
    """The cells (h, w) bool of each map in which something moves; ``before``: of the last time."""
    large = _large([cells.residual for cells in maps])

    def found(ignored: Sequence[Tensor], large: float, alone: bool) -> list[Tensor]:
        return [
            moving(cells, *elsewhere, large, last, alone)
            for cells, elsewhere, last in zip(
                maps, residuals_elsewhere(maps, ignored), before, strict=True
            )
        ]

    first = found(before, large, False)
    if _significant(first):
        return found(first, _LESS * large, True)
    return [torch.zeros_like(cells) for cells in first] if mode == "auto" else first


def moving(
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


def _large(residuals: Sequence[Tensor]) -> float:
    """The smallest large residual."""
    every = torch.cat([residual.flatten() for residual in residuals])
    position = round(_QUANTILE * (len(every) - 1))
    return max(_LARGE, _LARGE_TIMES * float(every.kthvalue(position + 1).values))


def _significant(found: Sequence[Tensor]) -> bool:
    """Whether something moves in several photos."""
    photos = sum(float(cells.float().mean()) >= _SHARE for cells in found)
    return photos >= max(_PHOTOS, _PHOTOS_SHARE * len(found))
