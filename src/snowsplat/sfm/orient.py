"""Orientation, origin and scale of the scene, estimated from the camera poses alone.

SfM determines the scene only up to a similarity transform. A viewer also needs the up direction, a
known scale, and the photographed object at the origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from snowsplat.scene.geometry import Similarity
from snowsplat.scene.orientation import VIEWING_DISTANCE, up_direction

if TYPE_CHECKING:
    import pycolmap


_POINTS_SAMPLED = 5000  # number of points from which medians are computed


@dataclass(frozen=True)
class _ModelData:
    """The data of a model that are used here, in the world frame of SfM; cameras sorted by name."""

    rotations: np.ndarray  # (N, 3, 3) of cam_from_world: the rows are the cameras' x, y, z axes
    centres: np.ndarray  # (N, 3)
    points: np.ndarray  # (P, 3), a sample of the points
    distances: np.ndarray  # (N,) median distance from a camera to its points; NaN without points

    @property
    def forward(self) -> np.ndarray:
        """(N, 3) the viewing directions."""
        return self.rotations[:, 2]


def orientation(model: pycolmap.Reconstruction) -> Similarity:
    """The transform ``scene_from_sfm``, from the world frame of SfM to that of the scene.

    In the frame of the scene, y points down, and z is the mean viewing direction, made horizontal.
    Up is the direction that makes the photos level. The origin is the point that the cameras look
    at. If they look outwards or all in the same direction, it is the median of the points. The
    scale makes the median distance from a camera to the points that it sees `VIEWING_DISTANCE`.

    Raises:
        ValueError: the model has no cameras.
    """
    data = _read(model)
    if not len(data.centres):
        raise ValueError("a model without cameras has no orientation")
    up = up_direction(data.rotations)
    forward = _horizontal_direction(data, up)
    down = -up
    rotation = np.stack([np.cross(down, forward), down, forward])
    scale = VIEWING_DISTANCE / _distance(data)
    origin = _origin(data)
    return Similarity(
        scale, torch.from_numpy(rotation), torch.from_numpy(-scale * rotation @ origin)
    )


def _read(model: pycolmap.Reconstruction) -> _ModelData:
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    poses = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    rotations = poses[:, :, :3]
    centres = -np.einsum("nji,nj->ni", rotations, poses[:, :, 3])
    numbers = sorted(model.points3D)
    chosen = numbers[:: max(1, len(numbers) // _POINTS_SAMPLED)]
    points = np.array([model.points3D[n].xyz for n in chosen]).reshape(-1, 3)
    index = {image.image_id: i for i, image in enumerate(images)}
    pairs = np.array(
        [
            (index[element.image_id], p)
            for p, n in enumerate(chosen)
            for element in model.points3D[n].track.elements
        ],
        np.int64,
    ).reshape(-1, 2)
    lengths = np.linalg.norm(points[pairs[:, 1]] - centres[pairs[:, 0]], axis=1)
    distances = np.full(len(images), np.nan)
    for i in range(len(images)):
        of_camera = lengths[pairs[:, 0] == i]
        if len(of_camera):
            distances[i] = np.median(of_camera)
    return _ModelData(rotations, centres, points, distances)


def _horizontal_direction(data: _ModelData, up: np.ndarray) -> np.ndarray:
    """(3,) unit vector: the horizontal part of the mean viewing direction.

    If this part is too short, that of the viewing direction of the first camera.
    """
    level = np.eye(3) - np.outer(up, up)
    # If the first camera looks straight down, use the direction of its upper image edge.
    candidates = (data.forward.mean(axis=0), data.forward[0], -data.rotations[0, 1])
    for direction, least in zip(candidates, (0.5, 0.1, 0.0), strict=True):
        horizontal = level @ direction
        length = float(np.linalg.norm(horizontal))
        if length > least:
            break
    return horizontal / length


def _origin(data: _ModelData) -> np.ndarray:
    """(3,) the point where the optical axes meet; if they do not meet, the median of the points."""
    meeting = _meeting_point(data)
    if meeting is not None:
        return meeting
    if len(data.points):
        return np.median(data.points, axis=0)
    return np.median(data.centres, axis=0)


def _meeting_point(data: _ModelData) -> np.ndarray | None:
    """(3,) the point with the least sum of distances to the optical axes.

    None if the axes are nearly parallel, if they do not come close to one point, or if that point
    is behind the cameras. Computed by iteratively reweighted least squares.
    """
    axes, centres = data.forward, data.centres
    # (N, 3, 3) matrices that project a vector onto the plane perpendicular to an axis.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < math.sin(math.radians(10)) ** 2:
        return None
    typical = _distance(data)
    weights = np.ones(len(axes))
    for _ in range(30):
        matrix = np.einsum("n,nij->ij", weights, across)
        point = np.linalg.solve(matrix, np.einsum("n,nij,nj->i", weights, across, centres))
        # The distances of the point from the axes.
        away = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centres), axis=1)
        weights = 1 / np.maximum(away, 0.01 * typical)
    ahead = np.einsum("ni,ni->n", point - centres, axes)  # the depth of the point in each camera
    is_met = (ahead > 0.2 * typical).mean() > 0.75 and np.median(away) < 0.5 * np.median(ahead)
    return point if is_met else None


def _distance(data: _ModelData) -> float:
    """Median over the cameras of the distance to their points; at least a positive number.

    Without points, the median distance of the cameras from the median of their centres.
    """
    distances = data.distances[np.isfinite(data.distances)]
    if not len(distances):
        distances = np.linalg.norm(data.centres - np.median(data.centres, axis=0), axis=1)
    distance = float(np.median(distances))
    return distance if distance > 0 else 1.0
