"""`Unexplained`: leaves out training views that the scene does not explain.

Their camera poses are wrong.

A photo with a wrong pose does not show what the other photos show at this place. The scene explains
the other photos. It can reproduce the photo with the wrong pose only by fog in front of the camera.
Early in training there is little such fog: the rendering of this view is then almost unrelated to
its photo, while the renderings of the views around it are already similar to their photos.

A photo with a right pose may show much that the scene does not explain: a tree in front of the
camera, or a place that few photos show. So a photo is left out only if the photos around it
contradict it: its pixels, moved to these photos at the depth of the scene, do not show the same
there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.data.photos.image_loader import ImageLoader
from snowsplat.evaluation.metrics import Rendering, color_fit, renderings
from snowsplat.evaluation.verdict import Grade, Reason
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import Renderer
from snowsplat.training.parts.part import Part, PartReport, Section
from snowsplat.training.parts.photo_agreement import confirmation
from snowsplat.training.processes.shards import sharded_render
from snowsplat.util.messages import Message, message, plural
from snowsplat.util.names import first_names
from snowsplat.util.settings import When

if TYPE_CHECKING:
    from snowsplat.training.core.run import Run

#: Width and height of the photos are divided by this number, or by less if they would be smaller
#: than the second number. More pixels do not help to distinguish wrong poses from correct ones. In
#: the first steps of the recipes, the photos have this size, too.
_DOWNSCALE, _SMALLEST = 4, 48
#: A view is compared with this number of views around it.
_NEIGHBOURS = 8
#: With fewer views, no view is left out: there are too few views around a view.
_FEWEST_VIEWS = 10

#: A view stands out if the explained share of the variance of its photo is smaller than the median
#: of the views around it by at least this number, and its PSNR is at most the second one, in dB.
_DIFFERENCE, _LOW_PSNR = 0.3, 20.0
#: `explanation_of` returns at most this PSNR.
_HIGHEST_PSNR = 60.0
#: If more than this share of the views stand out, the scene is unsuitable for this comparison.
_MOST = 0.25
#: The photos of this number of views around a view confirm its pose or contradict it, and those of
#: at most this number of other views tell what is chance: see `confirmation`.
_AROUND, _ANYWHERE = 4, 24
#: In standard deviations. Measured: at most 3 with wrong poses; at least 9 with right poses of the
#: photos that stood out.
_CONFIRMED = 5.0
#: Largest number of photos that a line names, and the page.
_LISTED, _LISTED_IN_PAGE = 10, 200
#: If more than this share of the photos is excluded, the verdict on the scene counts it.
_MANY = 0.05


class Unexplained(Part):
    """Decides once which views are used from then on."""

    name = "unexplained"

    def __init__(self, after: When) -> None:
        """
        ``after``: the moment of the decision.
        """
        self.after = after
        self._decided = False
        self._run: Run

    def begin(self, run: Run) -> None:
        """Remember the run, whose queue has the views that are left out."""
        self._run = run

    def between(self, run: Run) -> None:
        """Decide, at the first step from the moment on.

        Raises: UserError: a photo is missing or damaged.
        """
        if self._decided or run.step < run.schedule.step_of(self.after):
            return
        excluded = unexplained_views(
            run.gaussians,
            run.cameras.views(),
            run.images,
            background=run.background.evaluation,
            sh_degree=run.sh_degree,
            render=sharded_render(run.shards, with_depth=True),
        )
        self._decided = True
        run.queue.exclude(excluded, run.step)
        self._note()

    def _names(self) -> list[str]:
        return [self._run.dataset.train[i].name for i in self._run.excluded]

    def _note(self) -> None:
        if names := self._names():
            self._run.note(excluded_line(names))

    def report(self, run: Run, gaussians: Gaussians) -> PartReport:
        """The excluded photos."""
        names = self._names()
        if not names:
            return PartReport()
        count = len(run.dataset.train)
        text = message(
            "{number} of {count} photos contradict the others and were left out: {names}",
            number=len(names),
            count=count,
            names=first_names(names, 3),
        )
        section = Section(
            message("Photos that the scene does not explain"),
            (
                message(
                    "Left out of the training, because their camera poses are probably wrong: "
                    "{names}.",
                    names=first_names(names, _LISTED_IN_PAGE),
                ),
            ),
        )
        grade: Grade = "usable" if len(names) > _MANY * count else "good"
        return PartReport(reasons=(Reason(grade, text),), sections=(section,))

    def state(self) -> dict[str, Tensor]:
        """Whether it is decided, and the indices of the views that are left out."""
        excluded = torch.tensor(self._run.excluded, dtype=torch.int64)
        return {"checked": torch.tensor(self._decided), "left_out": excluded}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """See `Part.load`."""
        self._decided = bool(tensors["checked"])
        self._run.queue.excluded = tuple(tensors["left_out"].tolist())
        self._note()


def excluded_line(names: Sequence[str]) -> Message:
    """The line about photos that the scene does not explain; at least one name."""
    return plural(
        "{n} photo is not explained by the scene and left out of the training: {names}; its camera "
        "pose is probably wrong",
        "{n} photos are not explained by the scene and left out of the training: {names}; their "
        "camera poses are probably wrong",
        n=len(names),
        names=first_names(names, _LISTED),
    )


@torch.no_grad()
def unexplained_views(
    gaussians: Gaussians,
    views: Sequence[View],
    images: ImageLoader,
    *,
    background: Tensor,
    sh_degree: int,
    render: Renderer,
) -> tuple[int, ...]:
    """The indices of the views that the scene does not explain, ascending.

    These are the views that stand out (see `standing_out`) and that the photos around them do not
    confirm (see `confirmation`).

    Args:
        gaussians: the scene after a part of the training.
        views: the training views.
        images: the photos of the views.
        background: (3,) colour in 0..1, on the device of the Gaussians.
        sh_degree: degree of the spherical harmonics in use.
        render: renders the scene with its depth.

    Raises: UserError: a photo is missing or damaged.
    """
    if len(views) < _FEWEST_VIEWS:
        return ()

    downscale, side = _DOWNSCALE, min(views[0].camera.width, views[0].camera.height)
    while downscale > 1 and side < downscale * _SMALLEST:
        downscale //= 2

    def rendered(views: Sequence[View]) -> Iterator[Rendering]:
        return renderings(
            gaussians,
            views,
            images,
            background,
            downscale=downscale,
            sh_degree=sh_degree,
            render=render,
        )

    fits = [explanation_of(each.image, each.photo, each.mask) for each in rendered(views)]
    psnr, explained = np.array(fits).T
    poses = torch.stack([view.camera.cam_from_world.detach().cpu() for view in views])
    positions = torch.stack([view.camera.position.detach().cpu() for view in views]).numpy()
    directions = poses[:, 2, :3].numpy()
    found = standing_out(psnr, explained, positions, directions)
    if not found:
        return ()
    order = np.argsort(_distances(positions, directions), axis=1, kind="stable")[:, 1:]
    some = set(range(0, len(views), math.ceil(len(views) / _ANYWHERE)))
    wrong = []
    for index, each in zip(found, rendered([views[i] for i in found]), strict=True):
        around = [i for i in order[index] if i not in found][:_AROUND]
        anywhere = sorted(some - {index, *around})
        confirmed = confirmation(
            each,
            [views[i] for i in around],
            [views[i] for i in anywhere],
            images,
            background,
            downscale,
        )
        if confirmed < _CONFIRMED:
            wrong.append(index)
    return tuple(wrong)


def explanation_of(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> tuple[float, float]:
    """How well an image explains a photo, apart from a gain and an offset of each channel.

    For each channel, a gain and an offset of the image are fitted by least squares, so that the
    exposure and the white balance of the photo do not count.

    Args:
        image: (H, W, 3).
        photo: (H, W, 3) in 0..1.
        mask: (H, W) bool, False for pixels to ignore.

    Returns: The PSNR in dB after the fit, at most 60, and the share of the variance of the photo
    that the image explains, 0 to 1. Both have their largest value for a photo of one colour, and if
    the mask leaves no pixel.
    """
    fit = color_fit(image, photo, mask)
    if fit is None:
        return _HIGHEST_PSNR, 1.0
    gain, offset = fit
    rest, photo = photo.double() - gain * image.double() - offset, photo.double()
    if mask is not None:
        rest, photo = rest[mask], photo[mask]
    variance = photo.flatten(0, -2).var(0, correction=0).mean()
    error, variance = torch.stack([rest.square().mean(), variance]).tolist()
    psnr = -10.0 * math.log10(max(error, 10.0 ** (-_HIGHEST_PSNR / 10.0)))
    return psnr, max(0.0, 1.0 - error / variance) if variance > 0.0 else 1.0


def standing_out(
    psnr: np.ndarray, explained: np.ndarray, positions: np.ndarray, directions: np.ndarray
) -> tuple[int, ...]:
    """The views that are explained much less than the views around them.

    A view is compared with the median of the eight views around it. Of the views that stand out,
    the one with the largest difference is found first. The comparison is then repeated without this
    view, until no view stands out.

    The explained share is also low if a photo shows plain surfaces, because noise cannot be
    explained, and weak texture is explained late in the training. Such a photo has a high PSNR and
    therefore does not stand out.

    Args:
        psnr: (V,) in dB, see `explanation_of`.
        explained: (V,) in 0..1, see `explanation_of`.
        positions: (V, 3), the camera centres in world units.
        directions: (V, 3), the viewing directions, of length 1.

    Returns: The indices of the views found, ascending. No indices if there are fewer than 10 views,
    or if more than a quarter of the views stand out: then the scene does not explain the photos in
    general.
    """
    if len(psnr) < _FEWEST_VIEWS:
        return ()
    order = np.argsort(_distances(positions, directions), axis=1, kind="stable")
    fine = np.ones(len(explained), bool)
    while True:
        # For each view, the nearest views that were not found. A row begins with the view itself.
        around = np.stack([row[1:][fine[row[1:]]][:_NEIGHBOURS] for row in order])
        difference = np.median(explained[around], axis=1) - explained
        difference[~fine | (psnr > _LOW_PSNR)] = -np.inf
        worst = int(np.argmax(difference))
        if difference[worst] < _DIFFERENCE:
            return tuple(np.flatnonzero(~fine).tolist())
        fine[worst] = False
        if (~fine).sum() > _MOST * len(explained):
            return ()


def _distances(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(V, V): how far the cameras of two views are apart, in position and direction.

    This is the distance between the cameras, divided by the median distance, plus the angle between
    their viewing directions in radians. It is negative for a camera and itself, so that each camera
    is the first of its row.
    """
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    angles = np.arccos(np.clip(directions @ directions.T, -1.0, 1.0))
    distances: np.ndarray = apart / max(float(np.median(apart)), 1e-12) + angles
    np.fill_diagonal(distances, -1.0)
    return distances
