"""Training views that the scene does not explain, because their camera poses are wrong.

A photo with a wrong pose does not show what the other photos show at this place. The scene explains
the other photos; it can reproduce this one only by fog in front of its camera. Early in training
there is no such fog yet: the rendering of the view and its photo are then almost unrelated, while
the views around it are already similar to their photos.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.data.image_loader import ImageLoader
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render

#: Width and height of the photos are divided by this number. More pixels do not separate right and
#: wrong poses better, and in the first steps of the recipes the photos have this size, too.
_DOWNSCALE = 4
#: A view is compared with this number of views around it.
_NEIGHBOURS = 8
#: With fewer views, too few are left to compare with.
_FEWEST_VIEWS = 10
#: A view stands out if the scene explains at most this share of the variance of its photo,
_EXPLAINED = 0.65
#: at least this share of those of the views around it, in the median,
_EXPLAINED_AROUND = 0.6
#: if the difference of the two shares is at least this number,
_DIFFERENCE = 0.3
#: and this multiple of its usual deviation,
_DEVIATIONS = 4.0
#: if the PSNR is lower than that of the views around it by at least this number of decibels,
_WORSE_PSNR = 3.0
#: and if the PSNR is at most this number of decibels.
_LOW_PSNR = 20.0
#: `fitted` returns at most this PSNR.
_HIGHEST_PSNR = 60.0
#: If more than this share of the views stand out, the scene is unsuitable for this comparison.
_MOST = 0.25


@torch.no_grad()
def unexplained_views(
    gaussians: Gaussians,
    views: Sequence[View],
    images: ImageLoader,
    *,
    background: Tensor,
    sh_degree: int,
) -> tuple[int, ...]:
    """The indices of the views that the scene does not explain, ascending; see `standing_out`.

    Args:
        gaussians: the scene after a part of the training.
        views: the training views.
        images: the photos of the views.
        background: (3,) colour in 0..1, on the device of the Gaussians.
        sh_degree: degree of the spherical harmonics in use.

    Raises:
        UserError: a photo is missing or damaged.
    """
    if len(views) < _FEWEST_VIEWS:
        return ()
    images.prefetch(views, _DOWNSCALE)
    fits = np.empty((len(views), 2))
    for fit, view in zip(fits, views, strict=True):
        camera = view.camera.downscaled(_DOWNSCALE)
        camera = camera.to(gaussians.means.device)
        photo = images.get(view, _DOWNSCALE)
        image = render(gaussians, camera, background, sh_degree).image.clamp(0.0, 1.0)
        fit[:] = fitted(image, photo.over(background), photo.mask)
    poses = torch.stack([view.camera.cam_from_world.detach().cpu() for view in views])
    positions = torch.stack([view.camera.position.detach().cpu() for view in views])
    return standing_out(fits[:, 0], fits[:, 1], positions.numpy(), poses[:, 2, :3].numpy())


def fitted(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> tuple[float, float]:
    """How well an image explains a photo, if each channel may have another gain and offset.

    Gain and offset are fitted by least squares, so that the exposure and the white balance of the
    photo do not count.

    Args:
        image: (H, W, 3).
        photo: (H, W, 3) in 0..1.
        mask: (H, W) bool, False for pixels to ignore.

    Returns:
        The PSNR in dB after the fit, at most 60, and the share of the variance of the photo that
        the image explains, 0 to 1. Both are as large as possible for a photo of one colour, or if
        the mask leaves no pixel.
    """
    if mask is None:
        x, y = image.flatten(0, 1), photo.flatten(0, 1)
    else:
        x, y = image[mask], photo[mask]
    if not len(y):
        return _HIGHEST_PSNR, 1.0
    x, y = x.double(), y.double()
    x, y = x - x.mean(0), y - y.mean(0)
    gain = (x * y).sum(0) / x.square().sum(0).clamp_min(1e-12)
    # A negative gain would make a negative of the photo.
    rest = y - gain.clamp_min(0.0) * x
    error, variance = torch.stack([rest.square().mean(), y.square().mean()]).tolist()
    psnr = -10.0 * math.log10(max(error, 10.0 ** (-_HIGHEST_PSNR / 10.0)))
    return psnr, 1.0 - error / variance if variance > 0.0 else 1.0


def standing_out(
    psnr: np.ndarray, explained: np.ndarray, positions: np.ndarray, directions: np.ndarray
) -> tuple[int, ...]:
    """The views that are explained much less than the views around them.

    A view is compared with the median of its neighbours. The view that is worst in this comparison
    is taken out, until no view stands out. So the views that are found do not hide each other.

    The explained share is also low if a photo shows plain surfaces, because noise cannot be
    explained, and little texture only late. Such a photo has a high PSNR and therefore does not
    stand out.

    Args:
        psnr: (V,) in dB, see `fitted`.
        explained: (V,) in 0..1, see `fitted`.
        positions: (V, 3), the camera centres in world units.
        directions: (V, 3), the viewing directions, of length 1.

    Returns:
        Their indices, ascending. None if there are fewer than 10 views, or if more than a quarter
        of the views stand out: then the scene does not explain the photos in general.
    """
    count = len(psnr)
    if count < _FEWEST_VIEWS:
        return ()
    order = np.argsort(_distances(positions, directions), axis=1, kind="stable")
    fine = np.ones(count, bool)
    while True:
        # Of each row, the first views that are fine; the view itself is the first of its row.
        around = np.stack([row[1:][fine[row[1:]]][:_NEIGHBOURS] for row in order])
        explained_around = np.median(explained[around], axis=1)
        difference = explained_around - explained
        usual = np.median(difference[fine])
        deviation = 1.4826 * np.median(np.abs(difference[fine] - usual))
        stands_out = (
            fine
            & (explained <= _EXPLAINED)
            & (explained_around >= _EXPLAINED_AROUND)
            & (difference >= max(_DIFFERENCE, _DEVIATIONS * deviation))
            & (np.median(psnr[around], axis=1) - psnr >= _WORSE_PSNR)
            & (psnr <= _LOW_PSNR)
        )
        if not stands_out.any():
            return tuple(np.flatnonzero(~fine).tolist())
        fine[np.argmax(np.where(stands_out, difference, -np.inf))] = False
        if (~fine).sum() > _MOST * count:
            return ()


def _distances(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(V, V): distances between cameras; the median distance counts as much as one radian.

    The distance of a camera from itself is negative, so that it is the first of its row.
    """
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    angles = np.arccos(np.clip(directions @ directions.T, -1.0, 1.0))
    distances: np.ndarray = apart / max(float(np.median(apart)), 1e-12) + angles
    np.fill_diagonal(distances, -1.0)
    return distances
