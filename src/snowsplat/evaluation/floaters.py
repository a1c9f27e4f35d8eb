"""Floaters: Gaussians that hang in front of a surface, and Gaussians that no photo shows.

The blending weight of a Gaussian in a pixel is w = T α, with the transmittance T in front of it. A
Gaussian of a surface has its weight where the surface is: its depth is about that of the surface in
the same pixels. A floater has its weight in front of a surface that other Gaussians form. Let z be
the depth of a Gaussian in a view, and D(p) the depth of the surface in pixel p. Then

    position = z · Σ w(p) / D(p)  /  Σ w(p)

is about 1 on the surface and small in front of it; the sums are over the pixels in which there is a
surface.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render
from snowsplat.scene.sight import blended_sums, reduced_camera

Report = Callable[[int, int, str], None]


def _silent(done: int, total: int, what: str) -> None:
    pass


#: A pixel has a surface if the Gaussians that may form one cover this share of it.
_COVERED = 0.5
#: A Gaussian is in front of the surface of a view if its position is below this number.
_IN_FRONT = 0.8
#: The surface is found in this number of rounds: each ignores what was in front in the last one.
_ROUNDS = 3
#: A Gaussian is a floater if this share of its weight is in front.
_SHARE = 0.5
#: A Gaussian that covers less than this number of pixels in every view explains nothing.
_PIXELS = 0.01
#: Floaters are removed in this number of groups at first; at most this number of trials follows.
_GROUPS, _TRIALS = 8, 40


@dataclass
class Coverage:
    """What the views show of each of N Gaussians, in pixels of their reduced images."""

    weight: Tensor  # (N,) the sum of its blending weights, over the pixels of all views
    largest: Tensor  # (N,) the largest sum of a single view
    front: Tensor  # (N,) the part of ``weight`` of the views in which it is in front of a surface
    # (N,) the weighted mean of its positions, see above; 1 where there is no surface.
    position: Tensor

    @property
    def floaters(self) -> Tensor:
        """(N,) bool: the Gaussians that are mostly in front of a surface."""
        return self.front > _SHARE * self.weight

    @property
    def useless(self) -> Tensor:
        """(N,) bool: the Gaussians that no view shows."""
        return self.largest < _PIXELS


def coverage(gaussians: Gaussians, cameras: Sequence[Camera], report: Report = _silent) -> Coverage:
    """Render the views of the photos, and find out which Gaussians they show, and which in front.

    ``report`` is called with the number of rendered views, of all, and the word "views"; each view
    is rendered several times.
    """
    small = [reduced_camera(camera) for camera in cameras]
    solid = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    for i in range(_ROUNDS):
        found = _measure(gaussians, solid, _counted(small, i, report))
        solid = ~found.floaters
    return found


def _counted(cameras: Sequence[Camera], finished: int, report: Report) -> Iterator[Camera]:
    """The cameras of a round, after ``finished`` rounds."""
    for i, camera in enumerate(cameras):
        report(finished * len(cameras) + i, _ROUNDS * len(cameras), "views")
        yield camera


def _measure(gaussians: Gaussians, solid: Tensor, cameras: Iterable[Camera]) -> Coverage:
    """One round; the Gaussians ``solid`` (N,) form the surface."""
    surface = gaussians.select(solid)
    weight, largest, front, position = torch.zeros(4, len(gaussians), device=solid.device)
    for camera in cameras:
        ids, depth, sums = _weights(gaussians, surface, camera)
        total, behind, inverse = sums.unbind(1)
        # Where there is no surface, nothing can be in front of one.
        place = torch.where(behind > 0.5 * total, depth * inverse / behind.clamp_min(1e-12), 1.0)
        weight[ids] += total
        largest[ids] = torch.maximum(largest[ids], total)
        front[ids] += total * (place < _IN_FRONT)
        position[ids] += total * place
    return Coverage(weight, largest, front, position / weight.clamp_min(1e-12))


def _weights(
    gaussians: Gaussians, surface: Gaussians, camera: Camera
) -> tuple[Tensor, Tensor, Tensor]:
    """The ids (M,) of the Gaussians in a view, their depths (M,), and three sums (M, 3).

    The sums of their weights are over all pixels, over those with a surface, and over those, each
    divided by the depth of the surface.
    """
    with torch.no_grad():
        output = render(surface, camera, with_depth=True)
        assert output.depth is not None
        covered = (output.alpha > _COVERED) & (output.depth > 0.0)
        inverse = torch.where(covered, output.alpha / output.depth.clamp_min(1e-12), 0.0)
    each = torch.stack([torch.ones_like(inverse), covered.to(inverse.dtype), inverse], dim=2)
    return blended_sums(gaussians, camera, each)


def clean(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    quality: Callable[[Gaussians], float],
    enough: float = math.inf,
    report: Report = _silent,
) -> Gaussians:
    """The Gaussians without those that explain nothing, and without floaters if that does no harm.

    Floaters are removed in groups, those that are farthest in front first. A group is removed if
    the quality of the rest is not lower than before, or at least ``enough``. Otherwise each half of
    the group is tried.

    Args:
        cameras: those of the photos with which the scene was trained.
        quality: the larger, the better; for example the PSNR of held-out photos.
        report: as in `coverage`; then with the number of trials to remove a group, of the most
            that there may be, and the word "trials".
    """
    found = coverage(gaussians, cameras, report)
    kept = ~found.useless
    floaters = (found.floaters & kept).nonzero()[:, 0]
    floaters = floaters[found.position[floaters].argsort(stable=True)]
    best = quality(gaussians.select(kept))
    groups = list(floaters.tensor_split(_GROUPS))
    for trial in range(_TRIALS):
        while groups and not len(groups[0]):
            del groups[0]
        if not groups:
            break
        most = trial + sum(2 * len(group) - 1 for group in groups if len(group))
        report(trial, min(most, _TRIALS), "trials")
        group = groups.pop(0)
        kept[group] = False
        rest = quality(gaussians.select(kept))
        if rest >= min(best, enough):
            best = rest
            continue
        kept[group] = True
        if len(group) > 1:
            groups[:0] = group.tensor_split(2)
    return gaussians.select(kept)
