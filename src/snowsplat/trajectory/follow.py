"""Smooth ways through given cameras: near those of the training, or exactly through key cameras."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import quat_from_rotation, rotation_from_quat
from snowsplat.trajectory.focus import positions_of, rotations_of, typical, up_of
from snowsplat.trajectory.spline import Spline
from snowsplat.trajectory.tour import in_order
from snowsplat.util.errors import UserError

# What goes to and fro within so many photos is how a hand shakes, and half of it is left out.
_SMOOTHED_PHOTOS = 10
_SMOOTHING = (_SMOOTHED_PHOTOS / (2 * math.pi)) ** 4
_DENSE = 20  # places a frame at which the way is measured


def training_path(
    cameras: Sequence[Camera], names: Sequence[str], frames: int, distance: float
) -> list[Camera]:
    """The way of whoever took the photos, smoothed.

    Photos held sideways are turned as their neighbours; all frames have one angle of view.

    Args:
        names: of the photos; where they do not follow a way, a short tour takes their place.
        distance: world units from the cameras to what they see.

    Raises:
        UserError: all cameras are in one place and look one way.
    """
    order = in_order(cameras, names, distance)
    lens = typical(cameras)
    ways = [cameras[i] for i in order]
    rotations = _turned_alike(rotations_of(ways), up_of(cameras))
    zooms = torch.full((len(ways), 1), math.log(lens.fx / lens.width), dtype=torch.float64)
    return _path(lens, positions_of(ways), rotations, zooms, frames, distance, _SMOOTHING)


def key_path(cameras: Sequence[Camera], frames: int, distance: float) -> list[Camera]:
    """A smooth way through key cameras, in their order and with their angles of view.

    If the last one is as the first, the way is a loop and has no corner there. The frames have the
    size of the first camera.

    Raises:
        UserError: fewer than two that differ.
    """
    lens = cameras[0]
    zooms = [math.log(camera.fx / camera.width) for camera in cameras]
    zooms_column = torch.tensor(zooms, dtype=torch.float64)[:, None]
    return _path(
        *(lens, positions_of(cameras), rotations_of(cameras), zooms_column, frames, distance)
    )


def _turned_alike(rotations: Tensor, up: Tensor) -> Tensor:
    """(N, 3, 3): each turned by quarters about its line of sight to be like the one before it."""
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    turns = torch.stack([torch.linalg.matrix_power(turn, k) for k in range(4)])
    first = turns @ rotations[0]
    alike = [first[int((-first[:, 1] @ up).argmax())]]
    for rotation in rotations[1:]:
        turned = turns @ rotation
        # The trace of R Sᵀ is the larger, the smaller the angle between R and S.
        alike.append(turned[int((turned * alike[-1]).sum((1, 2)).argmax())])
    return torch.stack(alike)


def _path(
    lens: Camera,
    positions: Tensor,
    rotations: Tensor,
    zooms: Tensor,
    frames: int,
    distance: float,
    smoothing: float = 0.0,
) -> list[Camera]:
    """Frames along the spline of positions (K, 3), rotations and zooms (K, 1), even in `_steps`.

    Rotations are splines of quaternions of one sign, normalised after it: smooth to the second
    derivative, and near the shortest turn as neighbours are less than half a turn apart.
    """
    quats = quat_from_rotation(rotations)
    differ = torch.cat([torch.tensor([True]), _steps(positions, quats, distance) > 1e-6])
    positions, quats, zooms = positions[differ], quats[differ], zooms[differ]
    if len(positions) < 2:
        raise UserError(
            "all cameras are at one place and look one way; a film needs two that differ"
        )
    ends = torch.tensor([0, -1])
    from_end_to_end = float(_steps(positions[ends], quats[ends], distance))
    closed = len(positions) > 3 and from_end_to_end < 1e-6
    # Times of the square roots of distances ("centripetal") keep the curve from overshooting.
    steps = _steps(positions, quats, distance).sqrt()
    steps = (steps / steps.mean()).clamp_min(0.05)
    times = torch.cat([steps.new_zeros(1), steps.cumsum(0)])
    start, end = 0.0, float(times[-1])
    if closed:  # once more before and after it, so that the ends do not matter
        times = torch.cat([times[:-1] - end, times[:-1], times + end])
        positions, quats, zooms = (
            torch.cat([p[:-1], p[:-1], p]) for p in (positions, quats, zooms)
        )
    signs = torch.where((quats[1:] * quats[:-1]).sum(1) < 0, -1.0, 1.0).cumprod(0)
    quats = torch.cat([quats[:1], quats[1:] * signs[:, None].to(quats.dtype)])
    spline = Spline(times, torch.cat([positions, quats, zooms], 1), smoothing)

    dense = torch.linspace(start, end, _DENSE * max(frames, 50), dtype=torch.float64)
    way = spline(dense)
    length = torch.cat([way.new_zeros(1), _steps(way[:, :3], way[:, 3:7], distance).cumsum(0)])
    shares = torch.arange(frames, dtype=torch.float64) / max(1, frames if closed else frames - 1)
    at = spline(_interpolate(shares * length[-1], length, dense))
    return [_camera(lens, *row.split([3, 4, 1])) for row in at]


def _steps(positions: Tensor, quats: Tensor, distance: float) -> Tensor:
    """(K − 1,) by what angle, in radians, the picture moves from each camera to the next."""
    moved = (positions.diff(dim=0) / distance).norm(dim=1)
    unit = torch.nn.functional.normalize(quats, dim=1)
    # |p ± q| is the chord of a quarter of the turn each way: exact for small angles, too.
    chords = torch.minimum((unit[1:] - unit[:-1]).norm(dim=1), (unit[1:] + unit[:-1]).norm(dim=1))
    turned = 4 * torch.asin((chords / 2).clamp_max(1.0))
    return (moved.square() + turned.square()).sqrt()


def _interpolate(x: Tensor, xs: Tensor, ys: Tensor) -> Tensor:
    """Linear, of the samples (xs, ys); xs ascends."""
    i = torch.searchsorted(xs, x).clamp(1, len(xs) - 1)
    share = (x - xs[i - 1]) / (xs[i] - xs[i - 1]).clamp_min(1e-300)
    return ys[i - 1] + share * (ys[i] - ys[i - 1])


def _camera(lens: Camera, position: Tensor, quat: Tensor, zoom: Tensor) -> Camera:
    rotation = rotation_from_quat(quat)
    pose = torch.cat([rotation, -(rotation @ position)[:, None]], 1)
    fx = lens.width * math.exp(float(zoom))
    return dataclasses.replace(lens, fx=fx, fy=fx * lens.fy / lens.fx, cam_from_world=pose)
