"""Closed paths around one point, such as the focus of the cameras; all frames look at it."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera, near_of_overview
from snowsplat.scene.geometry import compose_rigid, look_at
from snowsplat.trajectory.focus import (
    DEFAULT_UP,
    focus_of,
    positions_of,
    rotations_of,
    typical,
    up_of,
    weighted_quantile,
)
from snowsplat.trajectory.spline import SAMPLES_PER_FRAME, interpolate
from snowsplat.util.errors import UserError

#: Cameras surround the focus if no gap between the azimuths of neighbours is wider than this.
WIDEST_GAP = math.radians(110)
# Largest elevation. Near the vertical, the image would rotate quickly.
_STEEPEST = math.radians(80)
# Cameras look in one direction if the mean of their unit forward vectors is at least this long.
# This corresponds to about 60° on each side of the mean.
_ONE_DIRECTION = 0.75
# Smallest half width and half height of an oval.
_LEAST_SWING = math.radians(2)
# Smallest ratio of the shorter to the longer axis of an oval.
_FLATTEST = 0.25
# Largest angle between the optical axes of a frame of a swing and of the photo.
_SWING = math.radians(4)
# Values outside of these quantiles are considered outliers.
_OUTERMOST = torch.tensor([0.1, 0.9], dtype=torch.float64)

# A closed path: parameters (N,) in [0, 1) -> positions (N, 3).
_Path = Callable[[Tensor], Tensor]


def ellipse_path(cameras: Sequence[Camera], frames: int, distance: float) -> list[Camera]:
    """An ellipse near the training cameras, around their focus, in ``frames`` frames.

    If the cameras surround the focus, the ellipse is horizontal, at their median height. Otherwise
    it is a vertical oval in front of the focus. Its width and height are the ranges of azimuth and
    elevation that the cameras cover. ``distance``: world units from the cameras to what they see.
    """
    up, focus = up_of(cameras), focus_of(cameras, distance)
    from_focus = positions_of(cameras) - focus
    heights = from_focus @ up
    level = from_focus - heights[:, None] * up
    east, north = _level_axes(level, up)
    azimuths = torch.atan2(level @ north, level @ east)
    gap, middle = widest_gap(azimuths)
    if gap < WIDEST_GAP:
        radii = level.norm(dim=1)
        low, high = torch.quantile(radii, _OUTERMOST)
        # On a circle the mean square of a coordinate is half the squared radius.
        squares = (torch.stack([level @ east, level @ north])).square().mean(1)
        a, b = (2 * squares).sqrt().clamp(low, high).tolist()
        height, start = float(heights.median()), float(azimuths[0])

        def ellipse(t: Tensor) -> Tensor:
            angle = start + 2 * math.pi * t
            x, y = a * angle.cos(), b * angle.sin()
            return focus + x[:, None] * east + y[:, None] * north + height * up

        return _looking_at(focus, up, ellipse, typical(cameras), frames)

    relative = torch.remainder(azimuths - middle + math.pi, 2 * math.pi) - math.pi
    elevations = torch.atan2(heights, level.norm(dim=1)).clamp(-_STEEPEST, _STEEPEST)
    (mid_azimuth, swing), (mid_elevation, rise) = _range(relative), _range(elevations)
    swing, rise = max(swing, _FLATTEST * rise), max(rise, _FLATTEST * swing)
    radius = float(from_focus.norm(dim=1).median())

    def oval(t: Tensor) -> Tensor:
        angle = 2 * math.pi * t
        azimuth = middle + mid_azimuth + swing * angle.sin()
        elevation = (mid_elevation + rise * angle.cos()).clamp(-_STEEPEST, _STEEPEST)
        x, y = elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin()
        flat = x[:, None] * east + y[:, None] * north
        return focus + radius * (flat + elevation.sin()[:, None] * up)

    return _looking_at(focus, up, oval, typical(cameras), frames)


def spiral_path(cameras: Sequence[Camera], frames: int, distance: float) -> list[Camera]:
    """A spiral for cameras that look in one direction: from their middle outwards and back.

    ``distance``: world units from the cameras to what they see.

    Raises:
        UserError: the cameras look in different directions.
    """
    forward = rotations_of(cameras)[:, 2].mean(0)
    if float(forward.norm()) < _ONE_DIRECTION:
        raise UserError(
            "a spiral needs cameras that look in one direction, but these cameras do not; use an "
            "ellipse"
        )
    up, focus = up_of(cameras), focus_of(cameras, distance)
    positions = positions_of(cameras)
    centre = torch.quantile(positions, _OUTERMOST, dim=0).mean(0)
    pose = look_at(centre, focus, up)
    offsets = ((positions - centre) @ pose[:, :3].T).abs()
    radii = torch.quantile(offsets, 0.8, dim=0).clamp_min(0.02 * distance)

    def spiral(t: Tensor) -> Tensor:
        # After two and a half turns, the direction at the end equals that at the start, so the
        # closed path has no corner.
        out, angle = (math.pi * t).sin(), 5 * math.pi * t
        along = 0.5 * (2 * math.pi * t).sin()
        offset = torch.stack([out * angle.cos(), -out * angle.sin(), along], 1)
        return centre + (radii * offset) @ pose[:, :3]

    return _looking_at(focus, up, spiral, typical(cameras), frames)


def orbit_path(
    points: Tensor, weights: Tensor, frames: int, width: int, height: int
) -> list[Camera]:
    """A horizontal circle around a scene whose cameras are not known; −y is up.

    ``points`` (P, 3) are the means of the Gaussians, ``weights`` (P,) their opacities. The images
    have ``width`` × ``height`` pixels.

    Raises:
        UserError: there are no points.
    """
    if not len(points):
        raise UserError("the scene has no Gaussians to orbit")
    points, weights = points.detach().to(torch.float64), weights.detach().to(torch.float64)
    focus = torch.stack([weighted_quantile(column, weights, 0.5) for column in points.T])
    # At this distance, half of the Gaussians fill half of the image.
    distances = (points - focus).norm(dim=1)
    radius = 3.0 * (float(weighted_quantile(distances, weights, 0.5)) or 1.0)
    elevation = math.radians(15)
    focal = 1.2 * min(width, height)
    pose = look_at(focus - torch.tensor([0.0, 0.0, radius]), focus, DEFAULT_UP)
    near = near_of_overview(radius)
    lens = Camera(width, height, focal, focal, width / 2, height / 2, pose, near)

    def circle(t: Tensor) -> Tensor:
        angle = 2 * math.pi * t
        level = radius * math.cos(elevation)
        y = torch.full_like(t, -radius * math.sin(elevation))
        return focus + torch.stack([level * angle.sin(), y, -level * angle.cos()], 1)

    return _looking_at(focus, DEFAULT_UP, circle, lens, frames)


def swing_path(camera: Camera, distance: float, frames: int) -> list[Camera]:
    """``frames`` cameras on an ellipse around the position of ``camera``, in its image plane.

    All look at the point at ``distance`` (world units) on its optical axis, so that this point does
    not move in the image. The ellipse is half as high as it is wide.
    """
    angles = 2 * math.pi * torch.arange(frames, dtype=torch.float64) / frames
    radius = distance * math.tan(_SWING)
    positions = torch.stack(
        [radius * angles.cos(), 0.5 * radius * angles.sin(), torch.zeros_like(angles)], dim=1
    )
    # In the frame of the camera; its y axis points down.
    target = torch.tensor([0.0, 0.0, distance], dtype=torch.float64).expand_as(positions)
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    poses = compose_rigid(look_at(positions, target, up), camera.cam_from_world.double())
    return [dataclasses.replace(camera, cam_from_world=pose) for pose in poses]


def _looking_at(focus: Tensor, up: Tensor, path: _Path, lens: Camera, frames: int) -> list[Camera]:
    """Cameras that look at the focus, at equal distances along a closed path."""
    t = torch.linspace(0, 1, SAMPLES_PER_FRAME * max(frames, 50) + 1, dtype=torch.float64)
    length = torch.cat([t.new_zeros(1), path(t).diff(dim=0).norm(dim=1).cumsum(0)])
    wanted = torch.arange(frames, dtype=torch.float64) / frames * length[-1]
    positions = path(interpolate(wanted, length, t))
    poses = look_at(positions, focus.expand_as(positions), up)
    return [dataclasses.replace(lens, cam_from_world=pose) for pose in poses]


def _level_axes(level: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (3,) perpendicular to ``up`` and to each other.

    The first is along the largest extent of the positions ``level`` (N, 3).
    """
    spare = torch.zeros(3, dtype=torch.float64)
    spare[int(up.abs().argmin())] = 1.0
    first = torch.linalg.cross(up, spare)
    first = first / first.norm()
    second = torch.linalg.cross(up, first)
    flat = level @ torch.stack([first, second], 1)
    longest = torch.linalg.eigh(flat.T @ flat).eigenvectors[:, 1]
    east = longest[0] * first + longest[1] * second
    return east, torch.linalg.cross(up, east)


def widest_gap(azimuths: Tensor) -> tuple[float, float]:
    """The width of the widest sector without a camera, and the middle of the remaining sector.

    All angles are in radians.
    """
    ascending = azimuths.sort().values
    gaps = torch.cat([ascending[1:], ascending[:1] + 2 * math.pi]) - ascending
    widest = int(gaps.argmax())
    opposite = float(ascending[widest] + gaps[widest] / 2) + math.pi
    return float(gaps[widest]), opposite


def _range(angles: Tensor) -> tuple[float, float]:
    """The middle and half the width of the range between the 10% and the 90% quantile."""
    low, high = torch.quantile(angles, _OUTERMOST).tolist()
    return (low + high) / 2, max((high - low) / 2, _LEAST_SWING)
