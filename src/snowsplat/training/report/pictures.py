"""The best and the worst views: photo, rendering, and error."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image

from snowsplat.data import ImageLoader, View
from snowsplat.evaluation.metrics import Evaluation, Rendering, ViewMetrics, renderings
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import in_colors, to_8bit
from snowsplat.util.image_size import scaled_size
from snowsplat.util.messages import Message, message

#: Number of views that are shown, of those with the lowest and the highest PSNR.
_WORST = 3
_BEST = 2
#: The longer side of an image, in pixels: about that of a screen, on which it can be opened.
_IMAGE_SIDE = 1280
#: The mean difference of the channels that is drawn white.
WHITE_ERROR = 0.25

# From 0 to `WHITE_ERROR`: black, red, orange, white.
_ERROR_COLORS = np.array(
    [[0, 0, 0], [96, 14, 30], [200, 60, 20], [250, 170, 60], [255, 255, 255]], np.float32
)
#: Largest number of photos that are shown: those with the largest masks.
_SHOWN = 12
#: The colour of masked parts, and its share.
_TINT, _SHARE = (255.0, 0.0, 200.0), 0.6


@dataclass(frozen=True)
class Compared:
    """A view: its metrics, and by their names the photo, the rendering and the error."""

    name: str
    metrics: ViewMetrics
    images: dict[str, Image.Image]


def compared(
    gaussians: Gaussians,
    views: Sequence[View],
    evaluation: Evaluation,
    background: tuple[float, float, float],
) -> list[tuple[Message, list[Compared]]]:
    """The views with the lowest and the highest PSNR in ``evaluation``, in groups with a title.

    Raises: UserError: a photo is missing or damaged.
    """
    color = torch.tensor(background, device=gaussians.means.device)
    order = sorted(evaluation.views, key=lambda metrics: metrics.psnr)
    groups = {
        message("Lowest PSNR"): order[:_WORST],
        message("Highest PSNR"): order[: -_BEST - 1 : -1],
    }
    if len(order) <= _WORST + _BEST:
        groups = {message("Photo, rendering, error"): order}
    by_name = {view.name: view for view in views}
    with ImageLoader(views, device=gaussians.means.device) as loader:

        def all_of(chosen: list[ViewMetrics]) -> list[Compared]:
            known = [metrics for metrics in chosen if metrics.name in by_name]
            drawn = renderings(gaussians, [by_name[each.name] for each in known], loader, color)
            return [_compared(*pair) for pair in zip(drawn, known, strict=True)]

        return [(title, all_of(chosen)) for title, chosen in groups.items()]


def _compared(drawn: Rendering, metrics: ViewMetrics) -> Compared:
    difference = (drawn.image - drawn.photo).abs().mean(2)
    if drawn.mask is not None:
        difference = torch.where(drawn.mask, difference, 0.0)
    error = in_colors(difference.cpu().numpy() / WHITE_ERROR, _ERROR_COLORS).astype(np.uint8)
    images = {"photo": to_8bit(drawn.photo), "rendering": to_8bit(drawn.image), "error": error}
    reduced_images = {what: reduced(each) for what, each in images.items()}
    return Compared(drawn.view.name, metrics, reduced_images)


def reduced(pixels: np.ndarray) -> Image.Image:
    """(H, W, 3) uint8 as an image whose longer side has at most `_IMAGE_SIDE` pixels."""
    image = Image.fromarray(pixels)
    return image.resize(scaled_size(*image.size, _IMAGE_SIDE), Image.Resampling.LANCZOS)


@dataclass(frozen=True)
class Masked:
    """A photo with its masked parts tinted, and their share of it, 0..1."""

    name: str
    image: Image.Image
    share: float


def masked(views: Sequence[View], masks: Mapping[str, Image.Image]) -> list[Masked]:
    """Photos in which something moves: those with the largest masks, the largest first.

    Args:
        views: the training views.
        masks: by the name of the view, of the size of its photo: 0 where something moves.

    Raises: UserError: a photo is missing or damaged.
    """
    if not masks:
        return []
    shares = {name: 1.0 - float(np.asarray(mask).mean()) / 255.0 for name, mask in masks.items()}
    largest = sorted(masks, key=lambda name: -shares[name])[:_SHOWN]
    by_name = {view.name: view for view in views}
    found = []
    with ImageLoader(views, background=(0.0, 0.0, 0.0)) as loader:
        for name in largest:
            photo = loader.get(by_name[name]).rgb.numpy().astype(np.float32)
            tinted = (1.0 - _SHARE) * photo + _SHARE * np.array(_TINT, np.float32)
            moves = np.asarray(masks[name])[:, :, None] == 0
            pixels = np.where(moves, tinted, photo).round().astype(np.uint8)
            found.append(Masked(name, reduced(pixels), shares[name]))
    return found
