"""The stops of a scene: the views of some of its photos, small pictures of them, and the subject.

The pictures are renders, because the photos may be elsewhere. All of them are in one image, from
left to right.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import NamedTuple

import torch
from PIL import Image
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import transform_points
from snowsplat.scene.initial_view import InitialView, bound, view_of_camera
from snowsplat.scene.render import render
from snowsplat.trajectory.focus import focus_of, positions_of

#: Largest number of stops; the pictures of so many fit on a small page.
MOST = 24
#: Height of a picture in pixels. It is displayed at half of that on a usual screen.
HEIGHT = 128
# The subject is around the focus of the cameras, closer to it than these. Its sphere contains this
# share of what the middle parts of the photos show, of this size relative to a photo.
_MIDDLE = 0.6
_SHARE = 0.9


class Stops(NamedTuple):
    """Stops and subject of a scene."""

    views: list[InitialView]  # one per stop, in the order of the photos
    pictures: bytes  # a WebP file with the pictures of all stops; empty if there are none
    middle: Tensor  # (3,) float64: the focus of the cameras
    radius: float  # the distance from the middle that contains most of it


def stops_of(
    gaussians: Gaussians, cameras: Sequence[Camera], depth: float, background: Sequence[float]
) -> Stops:
    """The stops of a scene.

    Args:
        cameras: of the photos, in their order. Without cameras, there are no stops, and the subject
            is the `bound` of the scene.
        depth: the distance of the targets of the views.
        background: red, green, blue in 0..1.
    """
    if not cameras:
        return Stops([], b"", *bound(gaussians))
    numbers = torch.linspace(0, len(cameras) - 1, min(len(cameras), MOST)).round().long().tolist()
    views = [view_of_camera(cameras[i], depth) for i in numbers]
    width = max(1, round(HEIGHT * views[0].aspect))
    looks = [_look(gaussians, view.camera(width, HEIGHT), background) for view in views]
    middle = focus_of(cameras, depth)
    distances = (torch.cat([points for _, points in looks]) - middle).norm(dim=1)
    distances = distances[distances < (positions_of(cameras) - middle).norm(dim=1).median()]
    radius = float(distances.quantile(_SHARE)) if len(distances) else depth
    return Stops(views, _side_by_side([picture for picture, _ in looks]), middle, max(radius, 1e-6))


def _look(
    gaussians: Gaussians, camera: Camera, background: Sequence[float]
) -> tuple[Image.Image, Tensor]:
    """What a camera sees: a picture, and the surface (P, 3) in its middle part."""
    with torch.no_grad():
        output = render(gaussians.detach(), camera, torch.tensor(background), with_depth=True)
    assert output.depth is not None
    pixels = output.image.clamp(0, 1).mul(255).round().to(torch.uint8).numpy()
    rows = torch.arange(camera.height, dtype=torch.float64)[:, None] + 0.5 - camera.cy
    columns = torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx
    middle = (rows.abs() < _MIDDLE / 2 * camera.height) & (
        columns.abs() < _MIDDLE / 2 * camera.width
    )
    alpha = output.alpha.double()
    z = output.depth.double() / alpha
    points = torch.stack([columns / camera.fx * z, rows / camera.fy * z, z], -1)
    return Image.fromarray(pixels), transform_points(
        camera.world_from_cam, points[middle & (alpha > 0.5)]
    )


def _side_by_side(pictures: Sequence[Image.Image]) -> bytes:
    """A WebP file of pictures of the same size, from left to right."""
    width, height = pictures[0].size
    strip = Image.new("RGB", (width * len(pictures), height))
    for i, picture in enumerate(pictures):
        strip.paste(picture, (i * width, 0))
    file = io.BytesIO()
    strip.save(file, "WEBP", quality=60, method=6)
    return file.getvalue()
