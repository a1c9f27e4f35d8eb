"""The Gaussians in the globe: selects the subject of a scene and moves it into the globe's frame.

The frame is that of `snowsplat.extras.globe.dimensions`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.extras.globe.dimensions import FLOOR, FLOOR_RADIUS
from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import transform
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity, look_at, rotation_from_quat
from snowsplat.scene.initial_view import overview
from snowsplat.scene.simplify import simplify
from snowsplat.trajectory.focus import (
    DEFAULT_UP,
    focus_of,
    positions_of,
    rotations_of,
    up_of,
    viewing_distance,
    weighted_quantile,
)
from snowsplat.trajectory.orbit import WIDEST_GAP, widest_gap
from snowsplat.util.errors import UserError

# Gaussians with a lower opacity are left out: as snow, they would be invisible.
_MIN_OPACITY = 0.02
# Radius of the subject as a share of the distance from the cameras to the focus.
_SUBJECT_RATIO = 0.42
# The subject fills this share of the radius of the floor.
_FILLS = 0.93
# Height of the subject, if it is tall: from the floor to 0.85 above the centre of the glass.
_TALLEST = FLOOR + 0.85
# A surface is a floor if its normal is within about 25° of the vertical, and if the cells of the
# histogram of heights that contain it have at least this share of all horizontal surfaces.
_HORIZONTAL = 0.9
_FLOOR_SHARE = 0.12
_HEIGHT_CELLS = 80
# Opacities decrease to 0 between these distances from the centre, including 2 σ of the Gaussian.
_FADE = (0.84, 0.97)
# A Gaussian is isolated if its neighbours are farther away than 3 times its size, and than this
# multiple of the median.
_ISOLATED = 8.0
# How far the scene may extend below the floor. A table top is not perfectly flat.
_SUNK = 0.03


@dataclass(frozen=True)
class Arrangement:
    """The Gaussians in a globe."""

    gaussians: Gaussians  # in the frame of the globe, by decreasing importance
    # Whether the cameras of the photos surround the scene, or are unknown. Otherwise its back was
    # not photographed.
    surrounded: bool


def arrange(gaussians: Gaussians, cameras: Sequence[Camera], count: int) -> Arrangement:
    """At most ``count`` Gaussians of the subject of a scene, in the frame of the globe.

    The subject is at the focus of the cameras of the photos. Without cameras, it is at the median
    of the Gaussians, and −y is up. It is scaled so that it fills the globe. It stands on the floor
    of the globe: the largest horizontal surface near the focus becomes the floor or, without such a
    surface, the lowest Gaussians do. What is outside of the glass or below the floor is left out,
    as are isolated Gaussians. Opacities decrease towards the glass.
    Raises: UserError: no Gaussians are left.
    """
    gaussians = gaussians.detach()
    usable = gaussians.usable_rows() & (gaussians.opacities > _MIN_OPACITY)
    gaussians = gaussians.select(usable)
    if not len(gaussians):
        raise UserError("the scene has no visible Gaussians; there is nothing to put into a globe")
    frame = _globe_frame(gaussians, cameras)
    inside = _inside(transform(gaussians, frame))
    if len(inside) > 8:
        spacing = ops.neighbours(inside.means, k=4).mean(1)
        isolated = (spacing > _ISOLATED * spacing.median()) & (spacing > 3 * inside.scales.amax(1))
        inside = inside.select(~isolated)
    if not len(inside):
        raise UserError(
            "no Gaussians are left near the middle of the scene; look at it with snowsplat view"
        )
    inside = simplify(inside, count)
    importance = inside.opacities.log() + inside.log_scales.amax(1)
    order = importance.argsort(descending=True, stable=True)
    return Arrangement(inside.select(order), _surrounded(frame, cameras))


def _globe_frame(gaussians: Gaussians, cameras: Sequence[Camera]) -> Similarity:
    """The similarity from the scene's frame to the globe's frame."""
    means = gaussians.means.double()
    if cameras:
        up = up_of(cameras)
        distance = viewing_distance(cameras, gaussians.means)
        focus = focus_of(cameras, distance)
        distances = (positions_of(cameras) - focus).norm(dim=1)
        # The distances are 0 if the cameras look outwards from one point.
        radius = _SUBJECT_RATIO * max(float(distances.median()), 0.01 * distance)
        front = positions_of(cameras)[0] - focus
        # If the first camera is at the focus or vertically above it, the front is behind this
        # camera, or below its lower edge.
        _, below, forward = rotations_of(cameras)[0]
        front = front + 1e-3 * distance * (below - forward)
    else:
        up, view = DEFAULT_UP, overview(gaussians)
        focus = torch.tensor(view.target, dtype=torch.float64)
        front = torch.tensor(view.position, dtype=torch.float64) - focus
        # `overview` shows the subject from this multiple of its radius: 1.6 / tan 30°.
        radius = float(front.norm()) / 2.77
    # Rows: right, down, forward of a level camera in front of the scene. Its frame becomes that of
    # the globe, so that the globe is first seen from the direction of the first photo.
    level = front - (front @ up) * up
    rotation = look_at(level, torch.zeros(3, dtype=torch.float64), up)[:, :3]
    around = (means - focus) @ rotation.T
    level_distance = around[:, ::2].norm(dim=1)
    floor = _floor_height(gaussians, rotation, around, radius)
    near = (level_distance < radius) & (around[:, 1] <= floor)
    weights = gaussians.opacities.double()
    if bool(near.any()):
        height = floor - float(weighted_quantile(around[near, 1], weights[near], 0.01))
        width = float(weighted_quantile(level_distance[near], weights[near], 0.98))
    else:
        height = width = radius
    # A slim subject is not enlarged until it touches the glass.
    fits = max(min(width, radius), 0.25 * radius) / (_FILLS * FLOOR_RADIUS)
    scale = 1.0 / max(fits, min(height, 2.0 * radius) / _TALLEST)
    origin = focus + rotation.T @ torch.tensor([0.0, floor, 0.0], dtype=torch.float64)
    down = torch.tensor([0.0, FLOOR, 0.0], dtype=torch.float64)
    return Similarity(scale, rotation, down - scale * rotation @ origin)


def _floor_height(gaussians: Gaussians, rotation: Tensor, around: Tensor, radius: float) -> float:
    """y of the largest horizontal surface near the focus, relative to the focus; down is positive.

    Without such a surface, it is the height above which 99.5% of the near Gaussians are.
    """
    near = (around[:, ::2].norm(dim=1) < 0.8 * radius) & (around[:, 1].abs() < radius)
    if not bool(near.any()):
        return radius
    near_gaussians, heights = gaussians.select(near), around[near, 1]
    axes = rotation_from_quat(near_gaussians.quats.double())
    scales, order = near_gaussians.scales.double().sort(dim=1)
    normals = axes.gather(2, order[:, None, :1].expand(-1, 3, 1))[:, :, 0] @ rotation.T
    weights = near_gaussians.opacities.double()
    flat = (normals[:, 1].abs() > _HORIZONTAL) & (scales[:, 0] < 0.5 * scales[:, 1])
    areas = weights * scales[:, 1] * scales[:, 2] * flat
    lowest = float(weighted_quantile(heights, weights, 0.995))
    cells = ((heights + radius) / (2 * radius) * _HEIGHT_CELLS).long().clamp(0, _HEIGHT_CELLS - 1)
    histogram = torch.zeros(_HEIGHT_CELLS + 2, dtype=torch.float64).index_add_(0, cells + 1, areas)
    # Three cells at a time, so that a surface at the border of two cells is found.
    sums = histogram[:-2] + histogram[1:-1] + histogram[2:]
    best = int(sums.argmax())
    if float(sums[best]) < _FLOOR_SHARE * float(areas.sum()) or not float(areas.sum()) > 0:
        return lowest
    surface = (cells - best).abs() <= 1
    return float(weighted_quantile(heights[surface], areas[surface], 0.5))


def _surrounded(frame: Similarity, cameras: Sequence[Camera]) -> bool:
    """Whether no sector around the globe that is wider than `WIDEST_GAP` is without a camera."""
    if not cameras:
        return True
    x, _, z = frame.apply(positions_of(cameras)).T
    return widest_gap(torch.atan2(x, z))[0] < WIDEST_GAP


def _inside(gaussians: Gaussians) -> Gaussians:
    """What is inside of the glass and above the floor, with opacities that fade at the glass."""
    axes = rotation_from_quat(gaussians.quats.double())
    factor = axes * gaussians.scales.double()[:, None, :]  # covariance = factor factorᵀ
    means = gaussians.means.double()
    distance = means.norm(dim=1)
    outward = means / distance.clamp_min(1e-9)[:, None]
    reach = distance + 2.0 * (outward[:, :, None] * factor).sum(1).norm(dim=1)
    lowest = means[:, 1] + 2.0 * factor[:, 1].norm(dim=1)
    fade = ((_FADE[1] - reach) / (_FADE[1] - _FADE[0])).clamp(0.0, 1.0)
    opacities = gaussians.opacities * (fade * fade * (3 - 2 * fade)).to(gaussians.means.dtype)
    keep = (opacities > _MIN_OPACITY) & (means[:, 1] < FLOOR + _SUNK) & (lowest < FLOOR + 2 * _SUNK)
    faded = replace(gaussians, opacity_logits=opacities.logit(1e-6))
    return faded.select(keep)
