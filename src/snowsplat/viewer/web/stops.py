"""The stops of a scene: the views of some of its photos, small pictures of them, and the subject.

A window of another shape than a photo shows what is beside the photo. How much of it other photos
show is measured, too, so that a page shows nothing that no photo shows.

The pictures are renders, because the photos may be elsewhere. All of them are in one image, from
left to right.
"""

import io
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from PIL import Image
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import transform_points
from snowsplat.scene.initial_view import InitialView, bounding_sphere, view_of_camera
from snowsplat.scene.render import render, to_8bit
from snowsplat.trajectory.focus import focus_of, positions_of

#: Largest number of stops; the pictures of so many fit on a small page.
MOST = 24
#: Height of a picture in pixels. It is displayed at half of that on a usual screen.
HEIGHT = 128
# The subject is around the focus of the cameras, closer to it than these. Its sphere contains this
# share of what the middle parts of the photos show, of this size relative to a photo.
_MIDDLE = 0.6
_SHARE = 0.9
_CORE = 0.5  # and its core this one
# Beside a photo, so many widths or heights of it are looked at, in a picture of this height.
_WIDEST, _BESIDE_HEIGHT = 3.0, 24
# This share of what is shown beside a photo must be in other photos. At most so many are compared.
_SEEN_SHARE, _COMPARED = 0.85, 100
# A stop holds the subject as well as another one if less than this is missing.
_AS_WELL = 0.3


class Stops(NamedTuple):
    """Stops and subject of a scene."""

    views: list[InitialView]  # one per stop, in the order of the photos
    pictures: bytes  # a WebP file with the pictures of all stops; empty if there are none
    middle: Tensor  # (3,) float64: the focus of the cameras
    radius: float  # the distance from the middle that contains most of it
    # For each stop, the largest width and height, relative to those of its view, of which photos
    # show most of what is beside the view; 1 to 3.
    seen: list[tuple[float, float]]
    # For each stop, half of the width and of the height, at a distance of 1, that hold the core of
    # the subject, which has half of what the radius has; 0 if it is not ahead.
    held: list[tuple[float, float]]

    def view(self, stop: int) -> InitialView:
        """A stop as the page shows it: all views have the shape of the first photo."""
        return self.views[stop].with_aspect(self.views[0].aspect)


def stops_of(
    gaussians: Gaussians, cameras: Sequence[Camera], depth: float, background: Sequence[float]
) -> Stops:
    """The stops of a scene, with the ``cameras`` of the photos in their order.

    Without cameras, there are no stops, and the subject is the `bounding_sphere` of the scene.
    ``depth``: the distance of the targets of the views. ``background``: red, green, blue in 0..1.
    """
    if not cameras:
        return Stops([], b"", *bounding_sphere(gaussians), [], [])
    numbers = torch.linspace(0, len(cameras) - 1, min(len(cameras), MOST)).round().long().tolist()
    views = [view_of_camera(cameras[i], depth) for i in numbers]
    width = max(1, round(HEIGHT * views[0].aspect))
    looks = [_look(gaussians, view.camera(width, HEIGHT), background) for view in views]
    middle = focus_of(cameras, depth)
    distances = (torch.cat([points for _, points in looks]) - middle).norm(dim=1)
    distances = distances[distances < (positions_of(cameras) - middle).norm(dim=1).median()]
    radius, core = (
        float(distances.quantile(share)) if len(distances) else depth for share in (_SHARE, _CORE)
    )
    others = cameras[:: -(-len(cameras) // _COMPARED)]
    seen = [_seen(gaussians, view.with_aspect(views[0].aspect), depth, others) for view in views]
    pictures = _side_by_side([picture for picture, _ in looks])
    held = [_held(view, middle, core) for view in views]
    return Stops(views, pictures, middle, max(radius, 1e-6), seen, held)


def first_stop(stops: Stops) -> int:
    """The stop with which a page begins: the first whose photo has as much of the core of the
    subject as any other. Windows of every shape show it; it has no use without stops."""
    shares = []
    for view, held in zip(stops.views, stops.held, strict=True):
        across, down = view.tangents()
        shares.append(min(1.0, across / held[0], down / held[1]) if held[0] else 0.0)
    return next(i for i, share in enumerate(shares) if share >= max(shares) - _AS_WELL)


def shown_at(stops: Stops, stop: int, width: int, height: int) -> Camera:
    """The camera of a window of this size, in pixels, at a stop.

    The window shows the rectangle of the view, but nothing that no photo shows, unless the core of
    the subject would be cut. `panel.js` does the same.
    """
    view = stops.view(stop)
    across, down = view.tangents()
    (wide, high), (left, up), aspect = stops.seen[stop], stops.held[stop], width / height
    limit = max(min(wide * across / aspect, high * down), up, left / aspect)
    focal = 0.5 * height / min(max(down, across / aspect), limit)
    return replace(view.camera(width, height), fx=focal, fy=focal)


def _held(view: InitialView, middle: Tensor, radius: float) -> tuple[float, float]:
    """Half of the width and of the height, at a distance of 1, that hold a sphere; 0 if the camera
    is in the sphere or looks away, as in photos of a room from its middle."""
    x, y, ahead = transform_points(view.camera(2, 2).cam_from_world, middle[None])[0].tolist()
    if ahead <= radius:
        return 0.0, 0.0
    return (abs(x) + radius) / ahead, (abs(y) + radius) / ahead


def _look(
    gaussians: Gaussians, camera: Camera, background: Sequence[float]
) -> tuple[Image.Image, Tensor]:
    """What a camera sees: a picture, and the surface (P, 3) in its middle part."""
    with torch.no_grad():
        output = render(gaussians.detach(), camera, torch.tensor(background), with_depth=True)
    assert output.depth is not None
    rows = torch.arange(camera.height, dtype=torch.float64)[:, None] + 0.5 - camera.cy
    columns = torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx
    middle = (rows.abs() < _MIDDLE / 2 * camera.height) & (
        columns.abs() < _MIDDLE / 2 * camera.width
    )
    alpha = output.alpha.double()
    z = output.depth.double() / alpha
    points = torch.stack([columns / camera.fx * z, rows / camera.fy * z, z], -1)
    return Image.fromarray(to_8bit(output.image)), transform_points(
        camera.world_from_cam, points[middle & (alpha > 0.5)]
    )


def _seen(
    gaussians: Gaussians, view: InitialView, depth: float, others: Sequence[Camera]
) -> tuple[float, float]:
    """See `Stops.seen`. What is hidden from another photo counts as seen by it. Where there is no
    surface, a place at ``depth`` must be in other photos."""
    height = _BESIDE_HEIGHT
    width = max(1, round(height * view.aspect))
    wide, high = round(_WIDEST * width), round(_WIDEST * height)
    camera = view.camera(width, height)
    camera = replace(camera, width=wide, height=high, cx=wide / 2, cy=high / 2)
    with torch.no_grad():
        output = render(gaussians.detach(), camera, with_depth=True)
    assert output.depth is not None
    alpha = output.alpha.double()
    z = torch.where(alpha > 0.5, output.depth.double() / alpha.clamp_min(0.5), depth)
    across = (torch.arange(wide, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    down = (torch.arange(high, dtype=torch.float64) + 0.5 - camera.cy)[:, None] / camera.fy
    points = torch.stack([across * z, down * z, z], -1)
    points = transform_points(camera.world_from_cam, points.reshape(-1, 3))
    poses = torch.stack([other.cam_from_world for other in others])
    x, y, ahead = (points @ poses[:, :, :3].mT + poses[:, None, :, 3]).unbind(2)  # (V, P) each
    lenses = [(c.fx, c.fy, c.cx, c.cy, c.width, c.height, c.near) for c in others]
    fx, fy, cx, cy, right, bottom, near = torch.tensor(lenses, dtype=torch.float64).T[:, :, None]
    x, y = fx * x / ahead + cx, fy * y / ahead + cy
    inside = (x >= 0) & (x <= right) & (y >= 0) & (y <= bottom) & (ahead > near)
    share = inside.any(0).reshape(high, wide).double()
    top, left = (high - height) // 2, (wide - width) // 2
    across_photo, down_photo = share[top : top + height], share[:, left : left + width]
    return _extent(across_photo.mean(0), width), _extent(down_photo.mean(1), height)


def _extent(seen: Tensor, size: int) -> float:
    """How many times ``size`` lines around the middle are seen, of all lines with these shares."""
    pairs = torch.minimum(seen, seen.flip(0))[: len(seen) // 2].flip(0)  # from the middle on
    beside = pairs[size // 2 :]
    count = torch.arange(1, len(beside) + 1)
    enough = (beside.cumsum(0) >= _SEEN_SHARE * count).nonzero()
    return 1.0 + 2.0 * (int(enough[-1]) + 1 if len(enough) else 0) / size


def _side_by_side(pictures: Sequence[Image.Image]) -> bytes:
    """A WebP file of pictures of the same size, from left to right."""
    width, height = pictures[0].size
    strip = Image.new("RGB", (width * len(pictures), height))
    for i, picture in enumerate(pictures):
        strip.paste(picture, (i * width, 0))
    file = io.BytesIO()
    strip.save(file, "WEBP", quality=60, method=6)
    return file.getvalue()
