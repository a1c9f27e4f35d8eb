"""How much the exposures of the photos differ, before the training.

The same points have other colours in photos of another exposure or white balance. For the colour
I_vpc of point p in channel c of photo v,

    log I_vpc = log c_pc + g_vc + noise,

where g_vc is the log-gain of the photo. Colours c and gains g are fitted by iteratively reweighted
least squares with the weight of Geman and McClure, which ignores observations that do not fit, for
example of points that are hidden or reflect light. Without enough points, the exposures in EXIF
data are used if all photos have them.

The gains are also fitted to two halves of the points, every second one. Noise differs between the
halves, but an exposure is the same in both. Thus the covariance of the two results is the variance
of the exposures.

Shiny surfaces and the light of a window are brighter from some places, too. But such differences
are others in other parts of the scene. So the scene is divided into octants. What is left of the
colours of an octant without the gains, as a median for each photo, must vary much less than the
gains. Again, this variance is the covariance of two halves. Or the gains differ much between photos
from about the same place, where surfaces shine alike.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from snowsplat.data.dataset import Dataset, View
from snowsplat.data.photos.decode import exif_exposure
from snowsplat.data.photos.image_loader import Photos
from snowsplat.scene.camera import Camera
from snowsplat.training.starts.point_colors import point_colors, point_pixels
from snowsplat.training.starts.source_views import source_views
from snowsplat.util.messages import Message, message
from snowsplat.util.process import single_threaded

#: Photos are encoded approximately by this power: value = light^(1 / 2.2).
GAMMA = 2.2
#: The log-gain of encoded values for one EV.
LOG_EV = math.log(2.0) / GAMMA
#: The colours of at least this number of points are compared, and of this number for each photo, as
#: a photo shows few of the points of a large scene; but there are at most so many colours in all.
_SAMPLE, _SAMPLE_OF_PHOTO, _MOST_COLORS = 1000, 20, 2_000_000
#: The photos are reduced by 4 or 2, to a longer side of at least this number of pixels.
_SIDE = 200
#: Darker values are noise, and brighter ones may be clipped.
_DARKEST, _BRIGHTEST = 0.06, 0.94
#: A point is hidden if another one is nearer by this factor, in the same of this number of cells
#: along the longer side of a photo.
_NEARER, _CELLS = 1.1, 40
#: Differences of logs at which an observation loses three quarters of its weight, in the first and
#: in the last iteration. It decreases, so that the gains may start far from the result.
_FIRST_SCALE, _SCALE = 1.0, 0.15
_ITERATIONS = 12
#: A photo needs observations of this total weight.
_LEAST_WEIGHT = 20.0
#: The exposures are known if this share of the photos has enough observations, or this number:
#: then those of the others are assumed to be the mean.
_LEAST_SHARE, _ENOUGH = 0.7, 20
#: The variance of what is left in the octants, relative to that of the gains, is at most this. In
#: photos where gains help it is 0.0 to 0.17, in photos with fixed exposure or gloss 0.34 to 15.
_MOST_LEFT = 0.25
#: Difference of photos from one place, in EV (gloss: 0.05 to 0.23), and most rays to find them.
_LEAST_JUMPS, _MOST_RAYS = 0.25, 100_000
#: Half of an octant has about so many colours in a photo, or more. This share of the products of
#: the medians of two halves is ignored at either end.
_LEAST_COLORS, _TRIMMED = 8, 0.05


@dataclass(frozen=True)
class ExposureStart:
    """The exposures of the training photos.

    Attributes:
        log_gains: (V, 3) float32: log of the factor by which each photo is brighter than the mean,
            in each channel of its encoded values. The mean over the photos is 0.
        spread: standard deviation of the exposures in EV (factors of two of light), over photos and
            channels; None if it is unknown.
        source: what the photos were compared by, for the user; None: they were not.
        everywhere: whether the differences are the same in all parts of the scene, as those of an
            exposure are.
    """

    log_gains: Tensor
    spread: float | None
    source: Message | None = None
    everywhere: bool = True


@single_threaded()
def exposure_start(dataset: Dataset, images: Photos) -> ExposureStart:
    """Compare the exposures of the training photos.

    ``images``: loads the photos.

    Raises: UserError: a photo is missing or damaged.
    """
    views = dataset.train
    if dataset.points is not None and len(views) > 1:
        xyz = dataset.points.xyz.cpu()
        most = min(_SAMPLE_OF_PHOTO * len(views), _MOST_COLORS // len(views))
        step = -(-len(xyz) // max(_SAMPLE, most))
        logs = _log_colors(views, xyz, step, images)
        one, other = log_gains(logs[:, ::2]), log_gains(logs[:, 1::2])
        products = one * other
        if int(products.isfinite().sum()) > 3 * min(_LEAST_SHARE * len(views), _ENOUGH):
            whole, variance = log_gains(logs), max(0.0, float(products.nanmean()))
            left = variance_left(logs - whole[:, None], xyz[::step].to(logs.device))
            sample = xyz[:: -(-len(xyz) * len(views) // _MOST_RAYS)].to(logs.device)
            sources = source_views([view.camera for view in views], sample, 1)
            nearest = [found[0] if found else i for i, found in enumerate(sources)]
            near = torch.tensor(nearest, device=logs.device)
            jumps = 0.5 * float(((one - one[near]) * (other - other[near])).nanmean())
            everywhere = left <= _MOST_LEFT * variance or jumps >= (_LEAST_JUMPS * LOG_EV) ** 2
            gains = (whole - whole.nanmean(0)).nan_to_num().to("cpu", torch.float32)
            return ExposureStart(gains, math.sqrt(variance) / LOG_EV, message("points"), everywhere)
    exposures = [exif_exposure(view.image.path) for view in views]
    known = [exposure for exposure in exposures if exposure is not None]
    if len(views) > 1 and len(known) == len(views):
        ev = torch.tensor(known, dtype=torch.float64)
        ev -= ev.mean()
        gains = (ev * LOG_EV).to(torch.float32)[:, None].expand(-1, 3)
        return ExposureStart(gains, float(ev.square().mean().sqrt()), message("EXIF data"))
    return ExposureStart(torch.zeros(len(views), 3), None)


def _log_colors(views: Sequence[View], xyz: Tensor, step: int, images: Photos) -> Tensor:
    """(V, P, 3) float64: logs of the colours of every ``step``-th point; NaN: not usable."""
    size = max(max(view.camera.width, view.camera.height) for view in views)
    downscale = next((factor for factor in (4, 2) if size >= factor * _SIDE), 1)
    images.prefetch(views, downscale)
    xyz = xyz.to(images.device)
    black, logs = xyz.new_zeros(3), []
    for view in views:
        colors, known = point_colors(view, images, xyz[::step], black, downscale)
        known = known & _visible(view.camera, xyz)[::step]
        usable = known[:, None] & (colors >= _DARKEST) & (colors <= _BRIGHTEST)
        logs.append(torch.where(usable, colors.to(torch.float64).log(), torch.nan))
    found = torch.stack(logs)
    # PyTorch warns that it has no deterministic median on a GPU.
    return found.cpu() if torch.are_deterministic_algorithms_enabled() else found


def _visible(camera: Camera, xyz: Tensor) -> Tensor:
    """(P,) bool: the points that are in the image, and not behind much nearer points."""
    pixels, inside = point_pixels(camera, xyz)
    depth = camera.project(xyz.to(torch.float64))[1]
    cell = (pixels * _CELLS / max(camera.width, camera.height)).floor().to(torch.int64)
    key = cell[:, 1] * (_CELLS + 1) + cell[:, 0]
    nearest = depth.new_full(((_CELLS + 1) ** 2,), math.inf)
    nearest.scatter_reduce_(0, key[inside], depth[inside], "amin")
    return inside & (depth <= _NEARER * nearest[key])


def variance_left(logs: Tensor, xyz: Tensor) -> float:
    """The variance of the colours of parts of the scene over the photos, beyond that of noise.

    Args:
        logs: (V, P, 3) float64, logs of colours without the gains; NaN where they are not known.
        xyz: (P, 3) positions of the points.

    Returns: NaN if no part has enough points.
    """
    # The median of two colours is one of them, so it would not differ.
    logs = torch.where(logs.isfinite().sum(0) >= 3, logs, torch.nan)
    rest = logs - logs.nanmedian(0).values
    octant = ((xyz > xyz.median(0).values) * xyz.new_tensor([1, 2, 4])).sum(1)
    found = [logs.new_zeros(0)]
    for part in (rest[:, octant == number] for number in range(8)):
        if part.shape[1] >= 2 * _LEAST_COLORS:
            product = part[:, ::2].nanmedian(1).values * part[:, 1::2].nanmedian(1).values
            found.append(product[part.isfinite().sum(1) >= 2 * _LEAST_COLORS])
    products = torch.cat(found)
    products = products[products.isfinite()].sort().values
    few = int(_TRIMMED * len(products))
    return float(products[few : len(products) - few].mean())


def log_gains(logs: Tensor) -> Tensor:
    """The log-gains of photos from the colours of points that several photos show.

    ``logs``: (V, P, 3) float64, logs of colours; NaN where the colour is not known.

    Returns: (V, 3) with mean 0; NaN for photos with too few points.
    """
    known = logs.isfinite()
    known &= known.sum(0) >= 2
    logs = torch.where(known, logs, torch.nan)
    # Medians are less exact, but do not need a start.
    gains = (logs - logs.nanmedian(0).values).nanmedian(1).values.nan_to_num()
    colors = (logs - gains[:, None]).nanmedian(0).values.nan_to_num()
    logs = logs.nan_to_num()
    for iteration in range(_ITERATIONS):
        progress = iteration / (_ITERATIONS - 1)
        scale = _FIRST_SCALE * (_SCALE / _FIRST_SCALE) ** progress
        rest = (logs - colors - gains[:, None]) / scale
        weights = known / (1.0 + rest.square()).square()
        total = weights.sum(1)
        gains = (weights * (logs - colors)).sum(1) / total.clamp_min(1e-9)
        gains = gains - gains.mean(0)
        colors = (weights * (logs - gains[:, None])).sum(0) / weights.sum(0).clamp_min(1e-9)
    return torch.where(total >= _LEAST_WEIGHT, gains, torch.nan)
