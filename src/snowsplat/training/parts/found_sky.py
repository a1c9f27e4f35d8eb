"""`find_sky`: in which directions the photos show the sky.

The sky has no points, and a plane sweep finds wrong depths there. Without Gaussians at its
distance, a training run explains it with fog before the cameras. What is very far away has a simple
property: all cameras, wherever they are, show the same colour in the same direction.

So the sphere of directions is divided into cells. A cell shows the sky if most of the photos that
show it, from positions that are far apart, have the same colour there, if it is above the horizon,
and if its region is not nearer (`far_regions`): a wall or a ceiling, too, may have one colour. The
parts of a photo near points of the dataset show the scene; they are not used. The same photos tell
where nothing is: a point which several of them would show before the sky is in empty space.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from snowsplat.data.dataset import Dataset, Points, View
from snowsplat.data.photos.image_loader import Photos
from snowsplat.scene.camera import Camera
from snowsplat.scene.orientation import scene_up
from snowsplat.training.parts.far_regions import (
    ANGLE,
    COUNT,
    cells_of,
    directions_of,
    in_far_regions,
    median_of,
    spread_of,
)
from snowsplat.training.starts.photos import in_threads, reduced_photo, usable_pixels

#: Distance of the sky from the middle of the cameras, in units of the root mean square of their
#: distances from it. From two of them, the sky is seen in directions that differ by a degree.
_DISTANCE = 100.0
#: At most this number of views is used, evenly chosen, to limit the time.
_VIEWS = 100
#: At most this number of points of the dataset is projected into each view.
_POINTS = 20_000
#: Photos are reduced so that a cell has this number of pixels squared.
_PIXELS = 2.0
#: Thin things are searched for at up to this multiple of the size. They differ from the sky by more
#: than this, in 0..255.
_FINE, _PLAIN = 4, 60.0
#: The parts of a photo within this number of cells around a point show the scene.
_AROUND = 1.5
#: Sine of the error of the horizon, which is that of the up direction of the cameras: 5°.
_BELOW_THE_HORIZON = 0.09
#: An overcast sky is brighter than this share of the scene in the same photo.
_DARKER = 0.8
#: The colours of two photos are the same if they differ by at most this, in 0..255.
_SAME = 20.0
#: A cell needs this number of photos, and this share of those that show it, of the same colour.
_FEWEST_VIEWS, _LEAST_AGREEMENT = 3, 0.5
#: The root mean square distance of these photos from their mean position, in units of the median
#: depth of the points. With less, a wall also has the same colour in the same direction.
_LEAST_BASELINE = 0.2
#: The largest difference between the sky and the background that is not visible, in 0..255.
_BACKGROUND = 2.0
#: If less than this share of the photos shows the sky, it is ignored.
_LEAST_SKY = 0.01


@dataclass(frozen=True)
class Sky:
    """What `find_sky` has found.

    Attributes:
        directions: (M, 3) float32, unit vectors in the world frame: the middles of the cells.
        colors: (M, 3) uint8.
        share: the share of the photos that shows the sky.
        middle: (3,) float32, the middle of the cameras, on the device of the photos.
        distance: of the sky from there, in world units.
        views: cameras of reduced photos, and where they show the sky, (H, W) bool; on the device
            of the photos. The other tensors are on the CPU.
    """

    directions: Tensor
    colors: Tensor
    share: float
    middle: Tensor
    distance: float
    views: list[tuple[Camera, Tensor]]

    def points(self, most: int, background: Sequence[float] | None = None) -> Points:
        """At most ``most`` points, on the CPU.

        ``background``: RGB in 0..1 behind the scene; a sky of this colour, such as the background
        of rendered images, needs no points.
        """
        behind = torch.tensor(background or (torch.inf,) * 3) * 255.0
        needed = ((self.colors - behind).abs() > _BACKGROUND).any(1).nonzero()[:, 0]
        chosen = needed[:: math.ceil(len(needed) / most) or 1]
        xyz = self.middle.cpu() + self.distance * self.directions[chosen]
        return Points(xyz, self.colors[chosen])

    def is_before(self, xyz: Tensor) -> Tensor:
        """(N,) bool: the points (N, 3) in the world frame, on the device of the views, that are not
        in the sky, although most of the photos that would show them show the sky there.
        """
        before = torch.zeros(len(xyz), dtype=torch.int16, device=xyz.device)
        shown = torch.zeros_like(before)
        for camera, sky in self.views:
            x, y, depth = _pixels(camera, xyz)
            shown += depth > 0.0
            before += (depth > 0.0) & sky[y, x]
        near = (xyz - self.middle).norm(dim=1) < 0.5 * self.distance
        return near & (before >= _FEWEST_VIEWS) & (before >= _LEAST_AGREEMENT * shown)


def sky_distance(cameras: Sequence[Camera]) -> float:
    """The distance of the sky from the middle of the cameras, in world units."""
    return _DISTANCE * float(_offsets(cameras)[1].square().sum(1).mean().sqrt())


def find_sky(dataset: Dataset, images: Photos, distance: float = 0.0) -> Sky | None:
    """The directions in which the photos show something very far away.

    ``distance``: of the sky from the middle of the cameras, in world units; 0: `sky_distance`.

    Returns: None if the photos hardly show it, or if this cannot be known: without points, or if
    all photos were taken from almost the same place.
    """
    if dataset.points is None:
        return None
    device = images.device
    views = dataset.train[:: math.ceil(len(dataset.train) / _VIEWS)]
    points = dataset.points.xyz
    points = points[:: max(1, len(points) // _POINTS)].to(device)
    cameras = [view.camera for view in dataset.train]
    up = _up(cameras)
    # A basis of the horizontal plane; small decompositions are slow on a GPU.
    axes = torch.linalg.svd(up[None])[2][1:].to(device)
    up = up.to(device)
    samples = in_threads(lambda view: _Sample.of(view, images, points, up, axes), views, device)
    cell = torch.cat([sample.cells for sample in samples])
    color = torch.cat([sample.colors for sample in samples])
    depths = torch.cat([sample.depths for sample in samples])
    if not len(depths):
        return None
    depth = float(depths.median())
    number = [len(sample.cells) for sample in samples]
    photo = torch.arange(len(samples)).repeat_interleave(torch.tensor(number)).to(device)
    origin, _ = _offsets(cameras)
    positions = torch.stack([view.camera.position.cpu() for view in views])
    offsets = (positions - origin).to(device, torch.float32)
    middle = median_of(cell, color)
    same = ((color - middle[cell]).abs() <= _SAME).all(1)
    shown = torch.bincount(cell, minlength=COUNT)
    agreeing = torch.bincount(cell[same], minlength=COUNT)
    is_sky = (
        (directions_of(torch.arange(COUNT, device=device)) @ up > -_BELOW_THE_HORIZON)
        & (agreeing >= _FEWEST_VIEWS)
        & (agreeing >= _LEAST_AGREEMENT * shown)
        & (spread_of(cell[same], offsets[photo[same]]) >= _LEAST_BASELINE * depth)
    )
    confirmed = same & is_sky[cell]
    if not confirmed.any():
        return None
    overcast = torch.cat([sample.overcast for sample in samples])
    confirmed[confirmed.clone()] = in_far_regions(
        cell[confirmed], photo[confirmed], color[confirmed], overcast[confirmed], offsets, depth
    )
    share = float(confirmed.sum()) / max(1, sum(sample.shown for sample in samples))
    if share < _LEAST_SKY:
        return None
    found = cell[confirmed].unique()
    masks = [
        (sample.camera.to(device), sample.mask(part))
        for sample, part in zip(samples, confirmed.split(number), strict=True)
    ]
    return Sky(
        directions_of(found).cpu(),
        middle[found].round().to(torch.uint8).cpu(),
        share,
        origin.to(device, torch.float32),
        distance or sky_distance(cameras),
        masks,
    )


def _up(cameras: Sequence[Camera]) -> Tensor:
    """(3,) float32, a unit vector: away from the ground."""
    rotations = torch.stack([camera.cam_from_world[:, :3].cpu() for camera in cameras])
    return torch.from_numpy(scene_up(rotations.to(torch.float64).numpy())).to(torch.float32)


def _offsets(cameras: Sequence[Camera]) -> tuple[Tensor, Tensor]:
    """The mean (3,) of the positions of the cameras, and their offsets (C, 3) from it."""
    positions = torch.stack([camera.position.cpu() for camera in cameras]).to(torch.float64)
    return positions.mean(0), positions - positions.mean(0)


@dataclass(frozen=True)
class _Sample:
    """A reduced photo.

    Attributes:
        cells: (M,) int64, without those of the scene.
        colors: (M, 3) float32 in 0..255, their mean colours.
        overcast: (M,) bool: cells that are brighter than most of the scene, and have none of it
            above.
        depths: (P,) of the points that the photo shows.
        shown: the number of all cells that the photo shows.
        pixels: (H, W) int64: the row in ``cells`` of each pixel; -1: the scene.
        plain: (H, W) bool: pixels without thin things before the sky, such as wires and branches.
    """

    camera: Camera
    cells: Tensor
    colors: Tensor
    overcast: Tensor
    depths: Tensor
    shown: int
    pixels: Tensor
    plain: Tensor

    @staticmethod
    def of(view: View, images: Photos, points: Tensor, up: Tensor, axes: Tensor) -> _Sample:
        """
        Args:
            points: (P, 3) in the world frame, on the device of the photos; so are the others.
            up: (3,), away from the ground.
            axes: (2, 3), unit vectors perpendicular to it and to each other.
        """
        scale = min(1.0, _PIXELS / ANGLE / max(view.camera.fx, view.camera.fy))
        width, height = (
            max(1, round(scale * side)) for side in (view.camera.width, view.camera.height)
        )
        camera = view.camera.scaled(width, height)
        photo = reduced_photo(view, images, width, height)
        fine = min(_FINE, view.camera.width // width, view.camera.height // height)
        detail = reduced_photo(view, images, fine * width, fine * height).planes[None].float()
        contrast = max_pool2d(detail, fine) + max_pool2d(-detail, fine)
        x, y, depth = _pixels(camera, points)
        visible = depth > 0.0
        scene = torch.zeros(1, 1, height, width, device=images.device)
        scene[0, 0, y[visible], x[visible]] = 1.0
        reach = math.ceil(_AROUND * _PIXELS)
        near = max_pool2d(scene, 2 * reach + 1, stride=1, padding=reach)[0, 0] > 0.0
        used = ~near
        usable = usable_pixels(photo)
        if usable is not None:
            used, near = used & usable, near & usable
        cells = cells_of(_rays(camera, images.device))
        cell, own = cells[used].unique(return_inverse=True)
        color = photo.rgb[used].to(torch.float32)
        total = color.new_zeros(len(cell), 3).index_add_(0, own, color)
        pixels = torch.full_like(cells, -1).masked_scatter_(used, own)
        colors = total / torch.bincount(own, minlength=len(cell))[:, None]
        scene_light = photo.rgb[near].to(torch.float32).mean(1).sort().values
        darker = torch.searchsorted(scene_light, colors.mean(1))
        overcast = (darker > _DARKER * len(scene_light)) & _is_open(cell, cells[near], up, axes)
        plain = (contrast <= _PLAIN).all(1)[0]
        shown = len(cells.unique())
        return _Sample(camera, cell, colors, overcast, depth[visible], shown, pixels, plain)

    def mask(self, confirmed: Tensor) -> Tensor:
        """(H, W) bool: the plain pixels of the cells (M,) bool, without those at their borders."""
        sky = torch.cat([confirmed, confirmed.new_zeros(1)])[self.pixels] & self.plain
        return max_pool2d((~sky)[None, None].float(), 3, stride=1, padding=1)[0, 0] == 0.0


def _is_open(cells: Tensor, scene: Tensor, up: Tensor, axes: Tensor) -> Tensor:
    """(M,) bool: the cells (M,) that have none of the cells ``scene`` (S,) above."""
    east, north = axes

    def azimuth_and_height(cells: Tensor) -> tuple[Tensor, Tensor]:
        directions = directions_of(cells)
        azimuth = torch.atan2(directions @ north, directions @ east) + math.pi
        return (azimuth / (2.0 * ANGLE)).long(), directions @ up

    highest = up.new_full((math.ceil(math.pi / ANGLE) + 1,), -torch.inf)
    highest.scatter_reduce_(0, *azimuth_and_height(scene), "amax")
    azimuth, height = azimuth_and_height(cells)
    return height > highest[azimuth]


def _pixels(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Columns and rows (P,) int64, and depths (P,): 0 for points (P, 3) outside of the image."""
    pixel, depth = camera.project(points)
    size = pixel.new_tensor([camera.width, camera.height])
    inside = (depth > 0.0) & (pixel >= 0.0).all(1) & (pixel < size).all(1)
    x, y = torch.where(inside[:, None], pixel, 0.0).long().unbind(1)
    return x, y, torch.where(inside, depth, 0.0)


def _rays(camera: Camera, device: torch.device) -> Tensor:
    """(H, W, 3) float32: the directions of the pixels in the world frame; not unit vectors."""
    sides = camera.height, camera.width
    y, x = torch.meshgrid([torch.arange(n, device=device) + 0.5 for n in sides], indexing="ij")
    right, down = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    rotation = camera.world_from_cam[:, :3].to(right)
    return torch.stack([right, down, torch.ones_like(right)], dim=2) @ rotation.T
