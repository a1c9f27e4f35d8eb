"""Paths of a hand-held camera through the scenes of `sfm_scenes.py`.

Each function returns ``cam_from_world`` (3, 4) float64 of ``count`` photos, in metres. z is up, and
the floor is at z = 0. Equal arguments return equal paths.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from snowsplat.scene.geometry import invert_rigid, look_at, quat_from_rotation, rotation_from_quat
from snowsplat.synthetic.photographer import roll
from snowsplat.trajectory.spline import Spline

_UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
_PHOTOS_OF_A_LOOP = 20
_PHOTOS_OF_A_TURN = 6
# The share of the way through the passage that the camera walks. It looks ahead by the rest, so at
# a corner it turns over several photos.
_WALKED = 0.8
_STEP = 1.0  # metres between two photos of a walk along a street
_HEIGHTS = (1.45, 1.75, 1.1)  # of the camera above the floor, in metres; one for each loop in turn


def loops(
    count: int,
    seed: int,
    half: tuple[float, float] = (1.65, 1.2),
    down: float = 0.0,
    outwards: bool = True,
) -> list[Tensor]:
    """Elliptical loops with the semi-axes ``half``, in metres.

    The camera looks across the room. If ``outwards``, it does so in the first, third … loop only,
    and looks outwards in the others. ``down`` lowers the point that the camera looks at, in metres.
    """
    random = np.random.default_rng([seed, count])
    rounds = max(1, min(6, count // _PHOTOS_OF_A_LOOP))
    positions, targets = [], []
    for i in range(count):
        number, angle = divmod(i * rounds / count, 1.0)
        number, angle = int(number), 2 * math.pi * angle + 0.4 * number
        size = 1 - 0.12 * (number // 2)
        at = np.array([half[0] * math.cos(angle), half[1] * math.sin(angle), 0]) * size
        at[2] = _HEIGHTS[number % 3]
        if outwards and number % 2:  # and a little ahead
            ahead = angle + 0.5
            to = at + 1.5 * np.array([math.cos(ahead), math.sin(ahead), 0])
        else:
            to = -0.9 * at
        to[2] = at[2] - 0.25 - down
        positions.append(at)
        targets.append(to)
    return _hand_held(positions, targets, random)


def level_loops(count: int, seed: int) -> list[Tensor]:
    """`loops` with a 360° camera on a stick: it turns with the walk, and is level within 1°."""
    poses = []
    random = np.random.default_rng([seed, count])
    for pose in loops(count, seed):
        view = invert_rigid(pose)
        ahead = view[:, 2] * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
        level = look_at(view[:, 3], view[:, 3] + ahead, _UP)
        poses.append(roll(level, random.normal(0, 0.017)))
    return poses


def in_between(poses: list[Tensor], count: int) -> list[Tensor]:
    """``count`` poses on a smooth path through ``poses``, from the first to the last."""
    views = invert_rigid(torch.stack(poses))
    quats = quat_from_rotation(views[..., :3])
    signs = torch.where((quats[1:] * quats[:-1]).sum(1) < 0, -1.0, 1.0).cumprod(0)
    quats = torch.cat([quats[:1], quats[1:] * signs[:, None].to(quats)])
    times = torch.arange(len(poses), dtype=torch.float64)
    path = Spline(times, torch.cat([views[..., 3], quats], 1))
    at = path(torch.linspace(0, len(poses) - 1, count, dtype=torch.float64))
    rotations = rotation_from_quat(torch.nn.functional.normalize(at[:, 3:], dim=1))
    return list(invert_rigid(torch.cat([rotations, at[:, :3, None]], 2)))


def looking_down(count: int, seed: int) -> list[Tensor]:
    """Loops on which the floor fills more than half of most photos."""
    return loops(count, seed, (1.9, 1.4), down=0.9, outwards=False)


def looking_across(count: int, seed: int) -> list[Tensor]:
    """Loops on which the camera never sees only the nearest wall."""
    return loops(count, seed, outwards=False)


def around_two(count: int, seed: int, distance: float = 4.4, radius: float = 1.55) -> list[Tensor]:
    """A figure of eight around two objects at x = ± half of ``distance``, in metres.

    ``radius`` is that of the circle around each object. Between the two circles, the camera turns
    from one object to the other.
    """
    random = np.random.default_rng([seed, count])
    turning = max(_PHOTOS_OF_A_TURN, count // 20)
    positions, targets = [], []

    def circle(side: int, photos: int) -> None:
        rounds = 1 if count < 150 else 2
        middle = np.array([side * distance / 2, 0.0, 0.0])
        for i in range(photos):
            share = i / photos
            angle = 2 * math.pi * share * rounds + (math.pi if side > 0 else 0)
            # If there are two rounds, the camera is higher in the second one.
            height = 1.2 + (0.4 if share * rounds >= 1 else 0)
            around = np.array([math.cos(angle), math.sin(angle) * (-side), 0.0])
            positions.append(middle + radius * around + np.array([0, 0, height]))
            targets.append(middle + np.array([0, 0, 0.62]))

    first = (count - turning) // 2
    circle(-1, first)
    gap = distance / 2 - radius
    ends = np.array([[-gap, 0, 1.2], [gap, 0, 1.2]])
    looks = np.array([[-distance / 2, 0, 0.62], [distance / 2, 0, 0.62]])
    _turn(positions, targets, (ends[0], looks[0]), (ends[1], looks[1]), turning)
    circle(1, count - turning - first)
    return _hand_held(positions, targets, random)


def ahead(count: int, seed: int, start: float = 5.0) -> list[Tensor]:
    """Along the middle of a street of `street_length`; the camera looks ahead."""
    return _along_street(count, seed, start, lambda i: 0.0, side=0.0)


def to_the_side(count: int, seed: int, start: float = 5.0) -> list[Tensor]:
    """Along one pavement; the camera looks at the façades of the other side."""
    return _along_street(count, seed, start, lambda i: math.pi / 2, side=-4.5)


def around_corners(count: int, seed: int, start: float = 5.0) -> list[Tensor]:
    """Along a street; the camera turns from side to side, once in about 15 photos."""
    return _along_street(count, seed, start, lambda i: 1.1 * math.sin(0.42 * i), side=-1.0)


def street_length(count: int) -> float:
    """The length in metres of a street for a walk of ``count`` photos."""
    return _STEP * count + 30.0


def _along_street(
    count: int, seed: int, start: float, heading: Callable[[int], float], side: float
) -> list[Tensor]:
    """A walk along +x with steps of `_STEP`. ``heading``: of the camera, in radians from +x."""
    random = np.random.default_rng([seed, count])
    positions, targets = [], []
    for i in range(count):
        at = np.array([start + _STEP * i, side + 0.4 * math.sin(0.3 * i), 1.6])
        angle = heading(i) + random.normal(0, 0.03)
        tilt = random.normal(0.03, 0.04)
        positions.append(at)
        targets.append(at + np.array([math.cos(angle), math.sin(angle), tilt]))
    return _hand_held(positions, targets, random)


def through_two_rooms(
    count: int, seed: int, middles: tuple[float, float], door: float, corridor: float
) -> list[Tensor]:
    """Loops in one room, then the way through the passage, then loops in the other room.

    In the rooms, the camera always looks across the room: a turn between two loops without photos
    of the turn could not be distinguished from a walk into the other room.

    Before the passage, the camera turns gradually from the last view of a loop to the direction of
    the passage. After the passage, it turns gradually to the first view of the next loop.

    The middles of the rooms are at (x, 0) for the two x of ``middles``. The door of a room is at
    x + ``door``. The passage runs along y = ``corridor``, which is negative. All are in metres.
    """
    random = np.random.default_rng([seed, count])
    between = max(1, round(0.3 * count))
    turning = max(_PHOTOS_OF_A_TURN, count // 20)
    first = (count - between - 2 * turning) // 2
    positions: list[np.ndarray] = []
    targets: list[np.ndarray] = []

    def loop(
        middle: float, photos: int, positions: list[np.ndarray], targets: list[np.ndarray]
    ) -> None:
        rounds = max(1, min(4, photos // _PHOTOS_OF_A_LOOP))
        for i in range(photos):
            number, share = divmod(i * rounds / photos, 1.0)
            angle = 2 * math.pi * share - math.pi / 2
            at = np.array([1.0 * math.cos(angle), 0.85 * math.sin(angle), 0])
            lift = _HEIGHTS[int(number) % 3]
            positions.append(at + np.array([middle, 0, lift]))
            targets.append(-1.1 * at + np.array([middle, 0, lift - 0.25]))

    loop(middles[0], first, positions, targets)
    a, b = middles
    corners = [(a, -0.6), (a + door, -1.3), (a + door, corridor), (b + door, corridor)]
    corners += [(b + door, -1.3), (b, -0.4), (b, 1.0)]
    way, ahead = [], []
    for i in range(between):
        share = (i + 0.5) / between * _WALKED
        way.append(np.array([*_along(corners, share), 1.45]))
        share += 1 - _WALKED
        ahead.append(np.array([*_along(corners, share), 1.3]))
    _turn(positions, targets, (positions[-1], targets[-1]), (way[0], ahead[0]), turning)
    positions += way
    targets += ahead
    second: tuple[list[np.ndarray], list[np.ndarray]] = [], []
    loop(middles[1], count - between - 2 * turning - first, *second)
    _turn(positions, targets, (way[-1], ahead[-1]), (second[0][0], second[1][0]), turning)
    positions += second[0]
    targets += second[1]
    return _hand_held(positions, targets, random)


def _turn(
    positions: list[np.ndarray],
    targets: list[np.ndarray],
    start: tuple[np.ndarray, np.ndarray],
    end: tuple[np.ndarray, np.ndarray],
    photos: int,
) -> None:
    """Append photos between two views, each a position and a target.

    The camera turns evenly, in the direction of the smaller angle.
    """
    (at, to), (last_at, last_to) = start, end
    azimuths = [math.atan2(*(target - position)[1::-1]) for position, target in (start, end)]
    turn = (azimuths[1] - azimuths[0]) % (2 * math.pi)
    if turn > math.pi:
        turn -= 2 * math.pi
    for i in range(1, photos + 1):
        share = i / (photos + 1)
        azimuth = azimuths[0] + share * turn
        position = at + share * (last_at - at)
        reach = np.linalg.norm((to - at)[:2])
        drop = (1 - share) * (to - at)[2] + share * (last_to - last_at)[2]
        ahead = np.array([reach * math.cos(azimuth), reach * math.sin(azimuth), drop])
        positions.append(position)
        targets.append(position + ahead)


def _along(corners: list[tuple[float, float]], share: float) -> np.ndarray:
    """The point (2,) at ``share`` (0 to 1) of the length of the line through ``corners``."""
    points = np.array(corners)
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = share * lengths[-1]
    return np.array([np.interp(at, lengths, points[:, axis]) for axis in (0, 1)])


def _hand_held(
    positions: list[np.ndarray], targets: list[np.ndarray], random: np.random.Generator
) -> list[Tensor]:
    """Poses that look at ``targets`` from ``positions``, with small random errors of both and of
    the roll angle."""
    poses = []
    for position, target in zip(positions, targets, strict=True):
        at = torch.from_numpy(position + random.normal(0, 0.025, 3))
        to = torch.from_numpy(target + random.normal(0, 0.05, 3))
        poses.append(roll(look_at(at, to, _UP), random.normal(0, 0.05)))
    return poses
