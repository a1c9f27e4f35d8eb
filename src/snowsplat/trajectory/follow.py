"""Smooth paths that follow given cameras: near the training cameras, or exactly through keys.

The first ones are visited in the order of their names, or in that of a short tour.
"""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import quat_from_rotation, rotation_from_quat
from snowsplat.trajectory.focus import positions_of, rotations_of, typical, up_of
from snowsplat.trajectory.spline import SAMPLES_PER_FRAME, Spline, interpolate
from snowsplat.util.errors import UserError
from snowsplat.util.natural_order import natural_key

# Oscillations with this period, in photos, are considered hand shake. The spline halves them.
_SMOOTHED_PHOTOS = 10
_SMOOTHING = (_SMOOTHED_PHOTOS / (2 * math.pi)) ** 4
#: If there are more cameras than this, only every n-th camera is used. A tour through all of them
#: would take long to compute and would look the same.
MOST_CAMERAS = 400
# The order of names is used if its length is at most this many times that of a short tour.
_LONGEST_BY_NAME = 1.6


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


def in_order(cameras: Sequence[Camera], names: Sequence[str], distance: float) -> list[int]:
    """Indices of the cameras in the order of a path.

    Photos of a walk and frames of a video are named in the order in which they were taken. Other
    cameras are visited by a tour with small changes of position and direction. Of the views of a
    panorama, only one is visited. ``distance``: world units from the cameras to what they see.
    """
    by_name = sorted(range(len(names)), key=lambda i: natural_key(names[i]))
    by_name = _one_per_place(cameras, by_name)
    step = -(-len(by_name) // MOST_CAMERAS)
    by_name = by_name[::step]
    chosen = [cameras[i] for i in by_name]
    places = torch.cat([positions_of(chosen) / distance, rotations_of(chosen)[:, 2]], 1)
    lengths = torch.cdist(places, places)
    tour = short_tour(lengths)
    as_named = list(range(len(by_name)))
    use_names = _length(lengths, as_named) <= _LONGEST_BY_NAME * _length(lengths, tour)
    return [by_name[i] for i in (as_named if use_names else tour)]


def _one_per_place(cameras: Sequence[Camera], order: list[int]) -> list[int]:
    """The cameras of ``order``; of those that follow one another at one place, only the one that
    looks most in the direction of the way to the next place.
    """
    centres, ahead = positions_of(cameras), rotations_of(cameras)[:, 2]
    places: list[list[int]] = []
    for i in order:
        if places and torch.allclose(centres[i], centres[places[-1][0]]):
            places[-1].append(i)
        else:
            places.append([i])
    chosen = []
    for k, place in enumerate(places):
        start, end = (k, k + 1) if k + 1 < len(places) else (max(0, k - 1), k)
        way = centres[places[end][0]] - centres[places[start][0]]
        chosen.append(max(place, key=lambda i: float(ahead[i] @ way)))
    return chosen


def short_tour(lengths: Tensor) -> list[int]:
    """A short open tour through N places, from their distances ``lengths`` (N, N).

    The tour always continues to the nearest place that is not yet visited. Then sections are
    reversed as long as that makes the tour shorter (2-opt).
    """
    count = len(lengths)
    # Start at the place that is farthest from the others; on a line of places it is an end.
    tour = [int(lengths.sum(1).argmax())] if count else []
    left = lengths.clone()
    while len(tour) < count:
        left[:, tour[-1]] = torch.inf
        tour.append(int(left[tour[-1]].argmin()))
    order = torch.tensor(tour, dtype=torch.int64)
    while count > 2:
        # Reversing places i … j replaces the step into i and the step out of j. At the ends of the
        # tour there is no such step.
        between = lengths[order][:, order]
        steps = torch.diagonal(between, 1)
        into = torch.cat([steps.new_zeros(1), steps])
        out = torch.cat([steps, steps.new_zeros(1)])
        new_into = torch.cat([steps.new_zeros(1, count), between[:-1]])  # (i, j): i − 1 to j
        new_out = torch.cat([between[:, 1:], steps.new_zeros(count, 1)], 1)  # (i, j): i to j + 1
        gain = (into[:, None] + out[None, :] - new_into - new_out).triu(1)
        best = int(gain.argmax())
        i, j = divmod(best, count)
        if float(gain[i, j]) <= 1e-9 * float(steps.sum()):
            break
        order[i : j + 1] = order[i : j + 1].flip(0)
    return order.tolist()


def _length(lengths: Tensor, tour: list[int]) -> float:
    return float(lengths[tour[:-1], tour[1:]].sum())
