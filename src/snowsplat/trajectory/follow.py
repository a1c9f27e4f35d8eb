"""Smooth paths that follow given cameras: near the training cameras, or exactly through keys."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import quat_from_rotation, rotation_from_quat
from snowsplat.trajectory.focus import positions_of, rotations_of, typical, up_of
from snowsplat.trajectory.spline import SAMPLES_PER_FRAME, Spline, interpolate
from snowsplat.trajectory.tour import in_order
from snowsplat.util.errors import UserError

# Oscillations with this period, in photos, are considered hand shake. The spline halves them.
_SMOOTHED_PHOTOS = 10
_SMOOTHING = (_SMOOTHED_PHOTOS / (2 * math.pi)) ** 4


def training_path(
    cameras: Sequence[Camera], names: Sequence[str], frames: int, distance: float
) -> list[Camera]:
    """The smoothed path of the photographer, in ``frames`` frames.

    Photos that were taken in portrait format are rotated to match their neighbours. All frames have
    the field of view of the median photo. If the ``names`` of the photos are not in the order of a
    path, a short tour through the cameras is used. ``distance``: world units from the cameras to
    what they see.

    Raises:
        UserError: all cameras have the same position and direction.
    """
    order = in_order(cameras, names, distance)
    lens = typical(cameras)
    ordered = [cameras[i] for i in order]
    rotations = _same_roll(rotations_of(ordered), up_of(cameras))
    zooms = torch.full((len(ordered), 1), math.log(lens.fx / lens.width), dtype=torch.float64)
    return _path(lens, positions_of(ordered), rotations, zooms, frames, distance, _SMOOTHING)


def key_path(
    cameras: Sequence[Camera],
    frames: int,
    distance: float,
    *,
    ease: bool = False,
    speeds: Sequence[float] | None = None,
) -> list[Camera]:
    """A smooth path through key cameras, in their order and with their fields of view.

    If the last key is the same as the first, the path is a closed loop without a corner. The frames
    have the image size of the first camera. ``distance``: world units from the cameras to what they
    see. ``ease``: slow at the start and at the end, instead of a constant speed.

    ``speeds``: one for each key, above 0, relative to each other, because ``frames`` is the
    duration. Between two keys, the speed changes in equal ratios. None: all are equal.

    Raises:
        UserError: fewer than two keys differ.
    """
    lens = cameras[0]
    logs = [[math.log(camera.fx / camera.width)] for camera in cameras]
    zooms = torch.tensor(logs, dtype=torch.float64)
    keys = positions_of(cameras), rotations_of(cameras), zooms
    given = None if speeds is None else torch.tensor(speeds, dtype=torch.float64)
    return _path(lens, *keys, frames, distance, ease=ease, speeds=given)


def _same_roll(rotations: Tensor, up: Tensor) -> Tensor:
    """Rotations (N, 3, 3), each rolled by a multiple of 90° to be closest to the one before."""
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    turns = torch.stack([torch.linalg.matrix_power(turn, k) for k in range(4)])
    first = turns @ rotations[0]
    result = [first[int((-first[:, 1] @ up).argmax())]]
    for rotation in rotations[1:]:
        candidates = turns @ rotation
        # The smaller the angle between R and S, the larger the trace of R Sᵀ.
        result.append(candidates[int((candidates * result[-1]).sum((1, 2)).argmax())])
    return torch.stack(result)


def _path(
    lens: Camera,
    positions: Tensor,
    rotations: Tensor,
    zooms: Tensor,
    frames: int,
    distance: float,
    smoothing: float = 0.0,
    *,
    ease: bool = False,
    speeds: Tensor | None = None,
) -> list[Camera]:
    """Frames along a spline, at equal distances in terms of `_steps`, unless ``speeds`` differ.

    Rotations are interpolated as a spline of quaternions whose signs agree, which is normalised
    afterwards. The result has a continuous second derivative. It is close to the shortest rotation,
    because neighbours differ by less than 180°.

    Args:
        lens: the camera whose image size and pixel aspect ratio all frames get.
        positions: (K, 3) camera centres in the world frame.
        rotations: (K, 3, 3) of cam_from_world.
        zooms: (K, 1) logarithms of focal length / image width.
        frames: number of frames.
        distance: world units from the cameras to what they see.
        smoothing: see `Spline`.
        ease: the way is 3t² − 2t³ of the time t in 0..1: the speed at both ends is 0.
        speeds: (K,) relative speeds at the cameras; None: they are equal.
    """
    quats = quat_from_rotation(rotations)
    differ = torch.cat([torch.tensor([True]), _steps(positions, quats, distance) > 1e-6])
    positions, quats, zooms = positions[differ], quats[differ], zooms[differ]
    speeds = None if speeds is None else speeds[differ]
    if len(positions) < 2:
        raise UserError(
            "all cameras have the same position and direction; a video needs two that differ"
        )
    ends = torch.tensor([0, -1])
    first_to_last = float(_steps(positions[ends], quats[ends], distance))
    closed = len(positions) > 3 and first_to_last < 1e-6
    # Time steps are square roots of distances ("centripetal"), which prevents overshooting.
    steps = _steps(positions, quats, distance).sqrt()
    steps = (steps / steps.mean()).clamp_min(0.05)
    times = torch.cat([steps.new_zeros(1), steps.cumsum(0)])
    start, end = 0.0, float(times[-1])
    keys = times
    if closed:  # repeat the loop before and after, so that the ends of the spline have no effect
        times = torch.cat([times[:-1] - end, times[:-1], times + end])
        positions, quats, zooms = (
            torch.cat([p[:-1], p[:-1], p]) for p in (positions, quats, zooms)
        )
    signs = torch.where((quats[1:] * quats[:-1]).sum(1) < 0, -1.0, 1.0).cumprod(0)
    quats = torch.cat([quats[:1], quats[1:] * signs[:, None].to(quats.dtype)])
    spline = Spline(times, torch.cat([positions, quats, zooms], 1), smoothing)

    dense = torch.linspace(start, end, SAMPLES_PER_FRAME * max(frames, 50), dtype=torch.float64)
    rows = spline(dense)
    passed = _steps(rows[:, :3], rows[:, 3:7], distance)
    if speeds is not None:  # what passes is time, not the way
        passed = passed / interpolate(0.5 * (dense[1:] + dense[:-1]), keys, speeds.log()).exp()
    passed = torch.cat([rows.new_zeros(1), passed.cumsum(0)])
    shares = torch.arange(frames, dtype=torch.float64) / max(1, frames if closed else frames - 1)
    if ease:
        shares = shares.square() * (3 - 2 * shares)
    at = spline(interpolate(shares * passed[-1], passed, dense))
    return [_camera(lens, *row.split([3, 4, 1])) for row in at]


def _steps(positions: Tensor, quats: Tensor, distance: float) -> Tensor:
    """(K − 1,) the angle in radians by which the image moves from each camera to the next."""
    moved = (positions.diff(dim=0) / distance).norm(dim=1)
    unit = torch.nn.functional.normalize(quats, dim=1)
    # A rotation by θ moves a unit quaternion by θ / 2, so the chord min |p ± q| is 2 sin(θ / 4).
    # This is accurate for small angles too.
    chords = torch.minimum((unit[1:] - unit[:-1]).norm(dim=1), (unit[1:] + unit[:-1]).norm(dim=1))
    turned = 4 * torch.asin((chords / 2).clamp_max(1.0))
    return (moved.square() + turned.square()).sqrt()


def _camera(lens: Camera, position: Tensor, quat: Tensor, zoom: Tensor) -> Camera:
    rotation = rotation_from_quat(quat)
    pose = torch.cat([rotation, -(rotation @ position)[:, None]], 1)
    fx = lens.width * math.exp(float(zoom))
    return dataclasses.replace(lens, fx=fx, fy=fx * lens.fy / lens.fx, cam_from_world=pose)
