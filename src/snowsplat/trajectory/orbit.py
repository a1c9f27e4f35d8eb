"""Closed ways around what the cameras look at, looking at it all the time."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at
from snowsplat.trajectory.focus import (
    HOUSE_UP,
    focus_of,
    positions_of,
    rotations_of,
    typical,
    up_of,
)
from snowsplat.util.errors import UserError

# Cameras stand all around something if no wider sector than this is without one.
_WIDEST_GAP = math.radians(110)
_STEEPEST = math.radians(80)  # nearer to straight above, the picture would turn quickly
_ONE_WAY = 0.75  # length of the mean of unit vectors: about 60° to each side of the middle
_LEAST_SWING = math.radians(2)
_FLATTEST = 0.25  # the shorter axis of an oval, in longer ones
_DENSE = 20  # places a frame at which the way is measured

# What lies beyond is taken for odd.
_OUTERMOST = torch.tensor([0.1, 0.9], dtype=torch.float64)

_Way = Callable[[Tensor], Tensor]  # (N,) of [0, 1) -> positions (N, 3), closed


def ellipse_path(cameras: Sequence[Camera], frames: int, distance: float) -> list[Camera]:
    """An ellipse through the middle of the training cameras, around what they look at.

    Where they stand all around it, the ellipse is level, at their height. Else it is an upright
    oval in front of it, as wide and high as the part of the directions that they cover.

    Args:
        distance: world units from the cameras to what they see.
    """
    up, focus = up_of(cameras), focus_of(cameras, distance)
    from_focus = positions_of(cameras) - focus
    heights = from_focus @ up
    level = from_focus - heights[:, None] * up
    east, north = _level_axes(level, up)
    azimuths = torch.atan2(level @ north, level @ east)
    gaps, middle = _widest_gap(azimuths)
    if gaps < _WIDEST_GAP:
        radii = level.norm(dim=1)
        low, high = torch.quantile(radii, _OUTERMOST)
        # The mean square of a circle's coordinate is half of its radius'.
        squares = (torch.stack([level @ east, level @ north])).square().mean(1)
        a, b = (2 * squares).sqrt().clamp(low, high).tolist()
        height, start = float(heights.median()), float(azimuths[0])

        def around(t: Tensor) -> Tensor:
            angle = start + 2 * math.pi * t
            x, y = a * angle.cos(), b * angle.sin()
            return focus + x[:, None] * east + y[:, None] * north + height * up

        return _looking_at(focus, up, around, typical(cameras), frames)

    turned = torch.remainder(azimuths - middle + math.pi, 2 * math.pi) - math.pi
    elevations = torch.atan2(heights, level.norm(dim=1)).clamp(-_STEEPEST, _STEEPEST)
    (mid_azimuth, swing), (mid_elevation, rise) = _range(turned), _range(elevations)
    swing, rise = max(swing, _FLATTEST * rise), max(rise, _FLATTEST * swing)
    radius = float(from_focus.norm(dim=1).median())

    def before(t: Tensor) -> Tensor:
        angle = 2 * math.pi * t
        azimuth = middle + mid_azimuth + swing * angle.sin()
        elevation = (mid_elevation + rise * angle.cos()).clamp(-_STEEPEST, _STEEPEST)
        x, y = elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin()
        return focus + radius * (
            x[:, None] * east + y[:, None] * north + elevation.sin()[:, None] * up
        )

    return _looking_at(focus, up, before, typical(cameras), frames)


def spiral_path(cameras: Sequence[Camera], frames: int, distance: float) -> list[Camera]:
    """From the middle of cameras that look one way, winding outwards and back in again.

    Raises:
        UserError: the cameras look every way.
    """
    forward = rotations_of(cameras)[:, 2].mean(0)
    if float(forward.norm()) < _ONE_WAY:
        raise UserError("a spiral is for cameras that look one way, these do not; take an ellipse")
    up, focus = up_of(cameras), focus_of(cameras, distance)
    positions = positions_of(cameras)
    centre = torch.quantile(positions, _OUTERMOST, dim=0).mean(0)
    pose = look_at(centre, focus, up)
    offsets = ((positions - centre) @ pose[:, :3].T).abs()
    radii = torch.quantile(offsets, 0.8, dim=0).clamp_min(0.02 * distance)

    def wind(t: Tensor) -> Tensor:
        # Two and a half turns: at the end it comes in as it went out, and the loop has no corner.
        out, angle = (math.pi * t).sin(), 5 * math.pi * t
        along = 0.5 * (2 * math.pi * t).sin()
        offset = torch.stack([out * angle.cos(), -out * angle.sin(), along], 1)
        return centre + (radii * offset) @ pose[:, :3]

    return _looking_at(focus, up, wind, typical(cameras), frames)


def orbit_path(
    points: Tensor, weights: Tensor, frames: int, width: int, height: int
) -> list[Camera]:
    """A level circle around points (P, 3) whose cameras are not known; −y is up.

    Args:
        weights: (P,) how much each counts: opacities.
        width, height: of the pictures, in pixels.

    Raises:
        UserError: no points.
    """
    if not len(points):
        raise UserError("the scene has no Gaussians to go around")
    points, weights = points.detach().to(torch.float64), weights.detach().to(torch.float64)
    focus = torch.stack([_weighted_median(column, weights) for column in points.T])
    # So far away that half of it fills half of the picture.
    radius = 3.0 * (float(_weighted_median((points - focus).norm(dim=1), weights)) or 1.0)
    elevation = math.radians(15)
    focal = 1.2 * min(width, height)
    lens = Camera(
        *(width, height, focal, focal, width / 2, height / 2),
        look_at(focus - torch.tensor([0.0, 0.0, radius]), focus, HOUSE_UP),
    )

    def around(t: Tensor) -> Tensor:
        angle = 2 * math.pi * t
        level = radius * math.cos(elevation)
        y = torch.full_like(t, -radius * math.sin(elevation))
        return focus + torch.stack([level * angle.sin(), y, -level * angle.cos()], 1)

    return _looking_at(focus, HOUSE_UP, around, lens, frames)


def _looking_at(focus: Tensor, up: Tensor, way: _Way, lens: Camera, frames: int) -> list[Camera]:
    """Frames at equal distances along a closed way."""
    t = torch.linspace(0, 1, _DENSE * max(frames, 50) + 1, dtype=torch.float64)
    length = torch.cat([t.new_zeros(1), way(t).diff(dim=0).norm(dim=1).cumsum(0)])
    wanted = torch.arange(frames, dtype=torch.float64) / frames * length[-1]
    i = torch.searchsorted(length, wanted).clamp(1, len(t) - 1)
    share = (wanted - length[i - 1]) / (length[i] - length[i - 1]).clamp_min(1e-300)
    positions = way(t[i - 1] + share * (t[i] - t[i - 1]))
    poses = look_at(positions, focus.expand_as(positions), up)
    return [dataclasses.replace(lens, cam_from_world=pose) for pose in poses]


def _level_axes(level: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (3,) across ``up``: along most of the places (N, 3), and across that."""
    spare = torch.zeros(3, dtype=torch.float64)
    spare[int(up.abs().argmin())] = 1.0
    first = torch.linalg.cross(up, spare)
    first = first / first.norm()
    second = torch.linalg.cross(up, first)
    flat = level @ torch.stack([first, second], 1)
    longest = torch.linalg.eigh(flat.T @ flat).eigenvectors[:, 1]
    east = longest[0] * first + longest[1] * second
    return east, torch.linalg.cross(up, east)


def _widest_gap(azimuths: Tensor) -> tuple[float, float]:
    """The widest sector without a camera, and the middle of all the others, in radians."""
    ascending = azimuths.sort().values
    gaps = torch.cat([ascending[1:], ascending[:1] + 2 * math.pi]) - ascending
    widest = int(gaps.argmax())
    opposite = float(ascending[widest] + gaps[widest] / 2) + math.pi
    return float(gaps[widest]), opposite


def _range(angles: Tensor) -> tuple[float, float]:
    """Middle of angles, and half of how far they go, without the outermost tenth at each end."""
    low, high = torch.quantile(angles, _OUTERMOST).tolist()
    return (low + high) / 2, max((high - low) / 2, _LEAST_SWING)


def _weighted_median(values: Tensor, weights: Tensor) -> Tensor:
    order = values.argsort()
    sums = weights[order].cumsum(0)
    return values[order[int(torch.searchsorted(sums, sums[-1] / 2).clamp_max(len(values) - 1))]]
