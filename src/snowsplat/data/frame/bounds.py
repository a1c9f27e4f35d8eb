"""An axis-aligned box around a scene, from its points or, without points, from its cameras; and
the near plane of the cameras."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from snowsplat.scene.camera import Camera, near_plane
from snowsplat.util.process import single_threaded

# At most this number of cameras is used, evenly chosen, to limit the time; of the points about this
# number, and more if that is too few for most cameras: each may see a small part of a large scene.
_CAMERAS, _POINTS, _MORE = 64, 10_000, 8
# The nearest points of a camera are ignored, because some points are wrong; and so are the cameras
# with the nearest points, of which some may be wrong.
_NEAREST, _NEAREST_CAMERAS = 0.02, 0.1
# Cameras that see fewer points are ignored.
_FEWEST = 20


def near_of(cameras: Sequence[Camera], points: Tensor | None) -> float:
    """The near plane for all cameras of a scene, in world units; see `near_plane`.

    It depends on the depths of the points that the cameras see. Without points, it depends on the
    distance between the cameras and the middle of `scene_bounds`. That is a guess if the cameras
    look in the same direction, so no more than the extent of the cameras is used.

    Args:
        cameras: at least one.
        points: (P, 3) in the world frame, or None.
    """
    used = cameras[:: math.ceil(len(cameras) / _CAMERAS)]
    depths = []
    if points is not None:
        step = max(1, len(points) // _POINTS)
        while len(depths := _depths(used, points[::step])) < len(used) / 2 and step > 1:
            step = max(1, step // _MORE)
    if depths:
        nearest, medians = np.array(depths).T
        return near_plane(float(np.median(medians)), float(np.quantile(nearest, _NEAREST_CAMERAS)))
    middle = scene_bounds(used).double().mean(0)
    away = [float((camera.position.detach() - middle).norm()) for camera in used]
    return near_plane(min(float(np.median(away)), scene_extent(used)))


@single_threaded()  # for so few points, threads take longer to start than to compute
def _depths(cameras: Sequence[Camera], points: Tensor) -> list[tuple[float, float]]:
    """For each camera that sees enough points: their 2% quantile and their median depth."""
    points = points.detach().cpu().double()
    levels = torch.tensor([_NEAREST, 0.5], dtype=torch.float64)
    found = []
    for camera in cameras:
        seen = camera.depths_in_view(points)
        if len(seen) >= _FEWEST:
            nearest, median = torch.quantile(seen, levels).tolist()
            found.append((nearest, median))
    return found


# Half the side of the cube, relative to half the visible width of the median camera at the
# distance of the cube's centre. With this value the cube of the synthetic Blender scenes is ±1.3,
# which is their known size.
_SHARE_OF_VIEW = 0.9
# A cube whose distance or size cannot be measured is placed with this many scene extents.
_GUESSED_EXTENTS = 5.0
#: The scene extent is this times the largest distance of a camera centre from the mean centre.
EXTENT_FACTOR = 1.1
# With fewer points than this, the box is computed from the cameras.
_MIN_POINTS = 100
# Below this smallest eigenvalue, all optical axes are within about two degrees of each other.
_PARALLEL_AXES = 1e-3


def scene_bounds(cameras: Sequence[Camera], points: Tensor | None = None) -> Tensor:
    """Lower and upper corner, (2, 3) float32, of an axis-aligned box in the world frame.

    With at least 100 points, the box spans their 1% to 99% quantiles along each axis.

    Otherwise it is a cube around the point nearest to all optical axes (least squares). Its size
    is what the median camera sees at that distance. Two kinds of datasets have no such point:

    - The cameras look in the same direction. The cube is placed five scene extents in front of
      them. This is a guess, because the distance is unknown.
    - The cameras look outwards. The cube is centred on them and reaches five extents to each side.

    Args:
        cameras: at least one.
        points: (P, 3) in the world frame, or None.

    Raises: ValueError: there are no cameras.
    """
    if not cameras:
        raise ValueError("scene_bounds needs at least one camera")
    if points is not None and len(points) >= _MIN_POINTS:
        low, high = np.quantile(points.detach().cpu().numpy(), (0.01, 0.99), axis=0)
        return torch.from_numpy(np.stack([low, high])).to(torch.float32)

    centres = torch.stack([camera.position.detach().to(torch.float64) for camera in cameras])
    axes = torch.stack(
        [camera.cam_from_world.detach()[2, :3].to(torch.float64) for camera in cameras]
    )
    # The tangent of half the smaller field of view.
    halves = [0.5 * min(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras]
    tangent = torch.tensor(halves).median()
    middle = centres.mean(0)
    spread = float((centres - middle).norm(dim=1).max()) or 1.0

    # Find the point p that minimises the sum over cameras of |(I − d dᵀ)(p − c)|², with centre c
    # and optical axis d. The matrix of this system is singular if all axes are parallel.
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    system = across.mean(0)
    if float(torch.linalg.eigvalsh(system)[0]) > _PARALLEL_AXES:
        centre = torch.linalg.solve(system, (across @ centres[:, :, None]).mean(0)[:, 0])
        depths = ((centre - centres) * axes).sum(1)
        if float((depths > 0).double().mean()) > 0.5:
            half = _SHARE_OF_VIEW * float(depths.median() * tangent)
            return _cube(centre, half)

    direction = axes.mean(0)
    if float(direction.norm()) > 0.5:
        distance = _GUESSED_EXTENTS * EXTENT_FACTOR * spread
        centre = middle + direction / direction.norm() * distance
        return _cube(centre, _SHARE_OF_VIEW * distance * float(tangent))
    return _cube(middle, _GUESSED_EXTENTS * EXTENT_FACTOR * spread)


def _cube(centre: Tensor, half: float) -> Tensor:
    return torch.stack([centre - half, centre + half]).to(torch.float32)


def scene_extent(cameras: Sequence[Camera]) -> float:
    """1.1 × the largest distance of a camera centre from the mean centre, in world units.

    This is the paper's scene extent. It scales the learning rate of positions and must not be 0,
    so it is 1 if all cameras have the same centre.
    """
    centres = torch.stack([camera.position.detach() for camera in cameras])
    radius = float((centres - centres.mean(0)).norm(dim=1).max())
    return EXTENT_FACTOR * radius if radius > 0.0 else 1.0
