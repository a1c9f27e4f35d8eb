"""`swept_points`: points on the surfaces, from depth maps that a plane sweep computes.

The sweep goes from coarse to fine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from snowsplat import ops
from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.photos.image_loader import Photos
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import compose_rigid
from snowsplat.training.starts.depth_map import LONGER_SIDE, DepthMap, photo_for_map
from snowsplat.training.starts.fusion import fused_points
from snowsplat.training.starts.photos import in_threads, usable_pixels
from snowsplat.training.starts.source_views import choose_views

#: Windows have (2 r + 1)² pixels.
_RADIUS = 3
#: The coarse sweep has one plane per pixel of displacement in the source view with the longest
#: baseline, within these limits.
_PLANES = (48, 128)
#: The fine sweep has this number of planes around the depth of the coarse sweep, ± this number of
#: coarse planes.
_FINE_PLANES, _FINE_RANGE = 8, 1.0
#: If the planes begin at infinity, depths within this number of them are no depths: displacements
#: so small do not tell them, and a few Gaussians far behind the scene change its mean depths.
_FROM_INFINITY = 2.0
#: A depth is kept if its mean correlation is at least this.
_LEAST_SCORE = 0.5
#: The range of inverse depths is that of the visible points without this share on each side,
#: extended by this factor.
_OUTLIERS, _MARGIN = 0.01, 1.2
#: With fewer visible points, a view has no depth map.
_FEWEST_POINTS = 8

_LUMINANCE = torch.tensor([0.299, 0.587, 0.114])


def swept_points(
    dataset: Dataset,
    images: Photos,
    count: int,
    generator: torch.Generator,
    longer_side: int = LONGER_SIDE,
) -> Points:
    """At most ``count`` points on the surfaces that several photos show, in the world frame, on the
    CPU.

    The depth maps of the training views are computed by plane sweep. The map of each view is
    checked with those of its source views; see `depth_maps` and `fused_points`.

    Args:
        generator: a random generator on the CPU.
        longer_side: the maximum size of the maps, in pixels.
    """
    chosen = choose_views(dataset, images, generator, longer_side)
    maps = depth_maps(chosen.views, chosen.sources, images, chosen.points, longer_side)
    return fused_points(chosen, maps, images, count, generator)


def depth_maps(
    views: Sequence[View],
    sources: Sequence[Sequence[int]],
    images: Photos,
    points: Tensor,
    longer_side: int = LONGER_SIDE,
) -> list[DepthMap | None]:
    """The depth map of each view; None for views without source views or visible points.

    See `swept_maps`.

    Args:
        sources: the source views of each view; see `source_views`.
        points: (P, 3) in the world frame. Those that a view shows determine its least depth. The
            largest one is infinite: a room behind an object, out of focus, has no points, and
            would be found at a wrong depth within their range.
        longer_side: the maximum size of the maps, in pixels.
    """
    device = images.device
    pictures = in_threads(lambda view: Picture.from_view(view, images, longer_side), views, device)
    ranges = [span and (0.0, span[1]) for span in depth_ranges(views, points.to(device))]
    return swept_maps(pictures, ranges, sources)


@dataclass(frozen=True)
class Picture:
    """A photo at the size of its depth map."""

    camera: Camera
    luminance: Tensor  # (H, W) float32, 0 to 1
    usable: Tensor | None  # (H, W) bool: False for masked and transparent pixels

    @staticmethod
    def from_view(view: View, images: Photos, longer_side: int) -> Picture:
        photo = photo_for_map(view, images, longer_side)
        luminance = photo.rgb.to(torch.float32) @ _LUMINANCE.to(photo.planes.device) / 255.0
        height, width = luminance.shape
        return Picture(view.camera.scaled(width, height), luminance, usable_pixels(photo))

    @cached_property
    def half(self) -> Picture:
        """The picture at half the size."""
        camera = self.camera.downscaled(2)
        size = (camera.height, camera.width)
        luminance, usable = self.luminance, self.usable
        luminance = interpolate(luminance[None, None], size, mode="area")[0, 0]
        if usable is not None:
            usable = interpolate(usable[None, None].float(), size, mode="area")[0, 0] > 0.5
        return Picture(camera, luminance.contiguous(), usable)


def swept_maps(
    pictures: Sequence[Picture],
    ranges: Sequence[tuple[float, float] | None],
    sources: Sequence[Sequence[int]],
) -> list[DepthMap | None]:
    """The depth map of each picture; None without source views or a range.

    The depth of a pixel is that with the highest mean correlation to the two best source views. A
    sweep at half the size searches the whole range; a second one refines its result.

    Args:
        ranges: the least and the largest inverse depth of each picture; see `depth_ranges`.
        sources: the source views of each; indices.
    """

    def swept(i: int) -> DepthMap | None:
        span, chosen = ranges[i], sources[i]
        if span is None or not chosen:
            return None
        return _swept(pictures[i], [pictures[j] for j in chosen], span)

    device = pictures[0].luminance.device if pictures else torch.device("cpu")
    return in_threads(swept, range(len(pictures)), device)


def _swept(picture: Picture, sources: list[Picture], span: tuple[float, float]) -> DepthMap:
    low, high = span
    coarse = _Level(picture.half, [source.half for source in sources])
    fine = _Level(picture, sources)
    shift = round(coarse.displacement(low, high))
    planes = min(max(shift, _PLANES[0]), _PLANES[1])
    rough, _ = coarse.sweep(low, high, planes)
    rough = interpolate(rough[None, None], fine.image.shape, mode="nearest")[0, 0]
    around = _FINE_RANGE * (high - low) / (planes - 1)
    inverse, score = fine.sweep(-around, around, _FINE_PLANES, rough)
    least = 0.0 if low > 0.0 else _FROM_INFINITY * around
    known = (score >= _LEAST_SCORE) & (inverse > least) & (rough > 0.0)
    if picture.usable is not None:
        known &= picture.usable
    return DepthMap(picture.camera, torch.where(known, inverse, 0.0))


def depth_ranges(views: Sequence[View], points: Tensor) -> list[tuple[float, float] | None]:
    """The range of inverse depths of each view, from the points, (P, 3), that it shows; or None.

    It is computed on the device of the points.
    """
    points = points.to(torch.float64)
    return [_inverse_depths(view.camera, points) for view in views]


def _inverse_depths(camera: Camera, points: Tensor) -> tuple[float, float] | None:
    """The range of inverse depths of the visible points; None if there are too few."""
    inverse = 1.0 / camera.depths_in_view(points)
    if len(inverse) < _FEWEST_POINTS:
        return None
    low, high = inverse.quantile(inverse.new_tensor([_OUTLIERS, 1.0 - _OUTLIERS])).tolist()
    return low / _MARGIN, high * _MARGIN


class _Level:
    """A view and its source views at one size, as `ops.plane_sweep` needs them."""

    def __init__(self, picture: Picture, sources: list[Picture]) -> None:
        self.image = picture.luminance
        self.sources = _stacked([source.luminance for source in sources])
        self.source_from_pixel = torch.stack(  # on the CPU
            [_source_from_pixel(picture.camera, source.camera) for source in sources]
        )

    def displacement(self, low: float, high: float) -> float:
        """By how many pixels the image of the central pixel moves between two inverse depths, in
        the source view in which it moves most.
        """
        h, w = self.image.shape
        middle = torch.tensor([0.5 * w, 0.5 * h, 1.0])
        lengths = []
        for matrix in self.source_from_pixel:
            ends = [matrix[:, :3] @ middle + inverse * matrix[:, 3] for inverse in (low, high)]
            if all(float(end[2]) > 0.0 for end in ends):
                a, b = (end[:2] / end[2] for end in ends)
                lengths.append(float((a - b).norm()))
        return max(lengths, default=0.0)

    def sweep(
        self, low: float, high: float, planes: int, centre: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        return ops.plane_sweep(
            self.image,
            self.sources,
            self.source_from_pixel.to(self.image.device),
            low,
            high,
            planes=planes,
            radius=_RADIUS,
            centre=centre,
        )


def _stacked(images: list[Tensor]) -> Tensor:
    """(S, H, W): smaller images are extended with NaN, which `ops.plane_sweep` does not use."""
    height, width = (max(image.shape[axis] for image in images) for axis in (0, 1))
    stack = images[0].new_full((len(images), height, width), torch.nan)
    for row, image in zip(stack, images, strict=True):
        row[: image.shape[0], : image.shape[1]] = image
    return stack


def _source_from_pixel(camera: Camera, source: Camera) -> Tensor:
    """(3, 4) [A | b]: pixel (u, v) at inverse depth w is at A (u, v, 1)ᵀ + w b in the source."""
    source_from_cam = compose_rigid(source.cam_from_world, camera.world_from_cam)
    matrix = source.intrinsics @ source_from_cam.to(torch.float64)
    matrix[:, :3] = matrix[:, :3] @ torch.linalg.inv(camera.intrinsics)
    return matrix.to(torch.float32)
