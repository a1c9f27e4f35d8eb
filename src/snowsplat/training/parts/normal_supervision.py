"""`NormalSupervision`: the surfaces of the scene have the normals that maps of the dataset state.

Networks estimate the normals of a photo more exactly than its depth. With N the normal of the map
in a pixel and N_d that of the rendered depth (`normals_of_depth`), the loss is the mean of

    w · c · log(1 + a / c),  a = 1 − N · N_d,  c = 1 − cos 15°

(Cauchy's robust loss of the angle): small angles count like their squares, and the pull of a large
one falls, so a part of a map that is wrong is outvoted by the photos. The weight w is the cosine
between N_d and the ray: the edges of the depth map look like steep surfaces.

Programs disagree about the axes of normal maps: y up or down, z towards the scene or the camera.
After a share of the steps, all maps are compared with the scene, which they have not influenced yet
(`_FROM`). The signs of the axes are those that agree with most of it, for all maps together. A map
that contradicts the scene then is not used: see `contradicting`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import median
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from snowsplat.data.dataset import View
from snowsplat.data.lens.resample import nearest
from snowsplat.data.maps.map_files import read_normal_file
from snowsplat.data.photos.image_loader import Photos
from snowsplat.scene.camera import Camera
from snowsplat.scene.render import RenderOutput
from snowsplat.scene.surface_normals import interior_pixels, normals_of_depth, rays_of
from snowsplat.training.parts.part import Part
from snowsplat.training.processes.shards import sharded_render
from snowsplat.training.starts.depth_map import LONGER_SIDE, check_aspect, photo_for_map
from snowsplat.training.starts.photos import usable_pixels
from snowsplat.training.step.batch import BatchView
from snowsplat.util.errors import UserError
from snowsplat.util.image_size import scaled_size
from snowsplat.util.messages import message
from snowsplat.util.names import first_names

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: c: the value of a at which a pixel has half the pull of its square.
_RESIDUAL = 1.0 - math.cos(math.radians(15.0))
#: The loss relative to that of the depth maps, with the same ``weight``.
_RELATIVE = 1.0
#: The share of the steps after which the maps are compared with the scene, and then used.
_FROM = 0.3
#: A map contradicts the scene if its mean cosine to the surfaces is less than this share of that of
#: the map of another photo, or of their mean direction (a wall would be 37 degrees wrong).
_LEAST_COSINE = 0.8
#: A map is compared with at most this number of maps of other photos.
_MOST_OTHERS = 64
#: They are compared at this fraction of their size: normals of a larger surface are more exact.
_COARSE = 4
#: A mean of normals is one of a surface if it is at least so long.
_SAME = 0.7
#: All maps together have at most this number of pixels, of three bytes.
_MOST_PIXELS = 21_000_000


class NormalSupervision(Part):
    """The loss of the normal maps, ``weight`` times.

    Attributes:
        signs: (3,) int8: what turns x, y and z of the maps into x right, y down, z forward; 0: not
            known yet.
        used: (V,) bool on the CPU: the views whose map is used.
    """

    name = "normals"

    def __init__(self, weight: float) -> None:
        self.weight = weight

    def prepare(self, run: Run) -> None:
        """Read the maps. Those that are damaged are left out."""
        views = run.dataset.train
        given = sum(view.normals is not None for view in views)
        side = min(LONGER_SIDE, int(math.sqrt(_MOST_PIXELS / max(given, 1))))
        self._maps: dict[int, Tensor] = {}  # (3, h, w) int8, 127 times the normals; 0: unknown
        damaged: UserError | None = None
        for index, view in enumerate(views):
            try:
                found = normal_map(view, run.images, side)
            except UserError as error:
                damaged = damaged or error
                continue
            if found is not None and bool(found.any()):
                self._maps[index] = (127.0 * found).round().to(run.device, torch.int8)
        self.used = torch.tensor([index in self._maps for index in range(len(views))])
        self.signs = torch.zeros(3, dtype=torch.int8)
        self.with_depth = bool(self._maps)
        self.idle = not self._maps
        if given:
            note = message(
                "normal maps: {maps} of {views} photos", maps=len(self._maps), views=len(views)
            )
            run.note(message("{note}; {damaged}", note=note, damaged=damaged) if damaged else note)

    def between(self, run: Run) -> None:
        """Compare the maps with the scene, once."""
        begun = run.step >= run.schedule.step_of(_FROM)
        if self.idle or not begun or bool(self.signs.any()):
            return
        views, render = run.cameras.views(), sharded_render(run.shards, with_depth=True)
        surfaces, stated, agreement = {}, {}, torch.zeros(3, device=run.device)
        for index, stored in self._maps.items():
            height, width = (max(3, side // _COARSE) for side in stored.shape[1:])
            camera = views[index].camera.scaled(width, height).to(run.device)
            shown = render(run.gaussians, camera, run.background.evaluation, run.sh_degree)
            assert shown.depth is not None
            own, weight = surfaces_of(shown.depth, shown.alpha, camera)
            surfaces[index] = own * (weight > 0.0)
            coarse = interpolate(stored[None].to(own), (height, width), mode="area")[0] / 127.0
            length = coarse.square().sum(0).sqrt()
            stated[index] = torch.where(length > _SAME, coarse / length, 0.0)
            turn = _rotation(views[index]).to(own)
            agreement += torch.einsum("ij,ihw,jhw->j", turn, surfaces[index], stated[index])
        signs = torch.where(agreement < 0.0, -1.0, 1.0)
        self.signs = signs.to("cpu", torch.int8)
        for index in stated:
            turn = _rotation(views[index]).to(signs) * signs
            stated[index] = torch.einsum("ij,jhw->ihw", turn, stated[index])
        if wrong := contradicting(surfaces, stated):
            self.used[wrong] = False
            names = first_names([views[index].name for index in wrong], 5)
            note = message(
                "normal maps that contradict the photos are not used: {names}", names=names
            )
            if not self.used.any():
                note = message("{note}; normals must be in the frame of the camera", note=note)
            run.note(note)

    def loss(self, run: Run, view: BatchView, rendered: RenderOutput) -> Tensor | None:
        """See the module. Each rendering has at most as many pixels as the map."""
        if not self.used[view.index] or not bool(self.signs.any()):
            return None
        assert rendered.depth is not None
        stored = self._maps[view.index]
        turn = _rotation(view.view) * self.signs / 127.0
        target = torch.einsum("ij,jhw->ihw", turn.to(rendered.depth), stored.to(rendered.depth))
        size = [min(a, b) for a, b in zip(rendered.alpha.shape, stored.shape[1:], strict=True)]
        if list(target.shape[1:]) != size:
            target = interpolate(target[None], size, mode="nearest-exact")[0]
        both = torch.stack([rendered.depth, rendered.alpha])
        if list(both.shape[1:]) != size:  # the nearest pixels would make steps in a plane
            both = interpolate(both[None], size, mode="bilinear")[0]
        term = normal_term(both[0], both[1], target, view.camera.scaled(size[1], size[0]))
        return self.weight * _RELATIVE * term

    def state(self) -> dict[str, Tensor]:
        """See `Part`."""
        return {} if self.idle else {"signs": self.signs, "used": self.used}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """See `Part`."""
        if not self.idle:
            self.signs = tensors["signs"].cpu()
            self.used = tensors["used"].cpu() & self.used


def normal_map(view: View, images: Photos, longer_side: int = LONGER_SIDE) -> Tensor | None:
    """The normal map of a view, (3, h, w) float32 with the axes of the file, in the frame of its
    photo; 0: unknown. None if there is none.

    Args:
        longer_side: the maximum size of the result, in pixels.

    Raises:
        UserError: the map is damaged, or not one of its photo.
    """
    if view.normals is None:
        return None
    values = read_normal_file(view.normals)
    check_aspect(view.normals, values.shape, view)
    width, height = scaled_size(view.camera.width, view.camera.height, longer_side)
    part = view.image.view
    if part is None:
        whole = torch.from_numpy(values).permute(2, 0, 1).nan_to_num(nan=0.0)
        found = interpolate(whole[None], (height, width), mode="area")[0]
    else:
        found = torch.from_numpy(nearest(values, part, width, height)).permute(2, 0, 1)
    length = found.square().sum(0).sqrt()
    known = length > _SAME
    usable = usable_pixels(photo_for_map(view, images, longer_side))
    if usable is not None:
        known &= usable.cpu()
    return torch.where(known, found / length, 0.0)


def normal_term(depth: Tensor, alpha: Tensor, target: Tensor, camera: Camera) -> Tensor:
    """The mean loss () of a view, differentiable in ``depth`` and ``alpha``.

    Args:
        depth: (H, W) Σ T α z in world units.
        alpha: (H, W) in 0..1.
        target: (3, H, W) normals in the camera frame; 0: unknown.
        camera: of this size.
    """
    surfaces, weight = surfaces_of(depth, alpha, camera)
    weight = weight * target.any(0)
    a = 1.0 - (surfaces * target).sum(0)
    # Rounding can make `a` a little negative.
    return _RESIDUAL * (weight * (a / _RESIDUAL).clamp_min(0.0).log1p()).sum() / a.numel()


def surfaces_of(depth: Tensor, alpha: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """The normals (3, H, W) of a rendered depth, and their weights (H, W), which are constant.

    The weight is the cosine to the ray, 0 where the pixel or one around it shows no surface. The
    arguments are those of `normal_term`.
    """
    shown = (alpha.detach() > 0.5) & (depth.detach() > 0.0)
    surfaces = normals_of_depth(
        torch.where(shown, depth, 1.0) / torch.where(shown, alpha, 1.0), camera
    )
    with torch.no_grad():
        rays = rays_of(camera, depth)
        cosine = -(surfaces * rays).sum(0) / rays.square().sum(0).sqrt()
        weight = interior_pixels(shown) * cosine.clamp_min(0.0)
    return surfaces, weight


def contradicting(surfaces: Mapping[int, Tensor], stated: Mapping[int, Tensor]) -> list[int]:
    """The numbers of the photos whose map is not that of the photo, ascending.

    With errors of the rendered normals of a photo, the mean cosines of all maps to them fall by the
    same factor, so their ratio tells which one fits. There are three tests:

    - The map of another photo fits clearly better than its own. (Of photos side by side, both fit.)
    - A map fits clearly worse than a single direction, the mean of the surfaces. An exact map fits
      at least as well.
    - Most of the maps that pass the first test fail the second one. Then all have another frame.

    Args:
        surfaces: (3, h, w) unit normals that are rendered, by the number of the photo; 0: unknown.
        stated: the same of the maps, in the frame of the camera.
    """
    some = list(stated)[:: -(-len(stated) // _MOST_OTHERS)]
    ratios, others = {}, []
    for index, own in surfaces.items():
        cosines = (own * stated[index]).sum(0)
        known = own.any(0) & stated[index].any(0)
        if not known.any():
            continue
        if any(_fits_better(stated[k], own, cosines, known) for k in some if k != index):
            others.append(index)
        else:
            ratios[index] = float(cosines[known].mean() / own[:, known].mean(1).norm())
    limit = _LEAST_COSINE
    if ratios and median(ratios.values()) < limit:
        limit = math.inf
    return sorted([*others, *(index for index, ratio in ratios.items() if ratio < limit)])


def _fits_better(other: Tensor, surfaces: Tensor, cosines: Tensor, known: Tensor) -> bool:
    """Whether the map of another photo fits clearly better, in the pixels that both maps know."""
    if other.shape != surfaces.shape:
        other = interpolate(other[None], surfaces.shape[1:], mode="nearest-exact")[0]
    both = known & other.any(0)
    enough = 2 * both.sum() > known.sum()
    fits = (surfaces * other).sum(0)[both].sum()
    return bool(enough & (cosines[both].sum() < _LEAST_COSINE * fits))


def _rotation(view: View) -> Tensor:
    """(3, 3) float64: from the frame of the photo to that of the view."""
    part = view.image.view
    if part is None or part.rotation is None:
        return torch.eye(3, dtype=torch.float64)
    return torch.tensor(part.rotation, dtype=torch.float64)
