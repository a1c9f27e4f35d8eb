"""The cameras and points of a model, and the point that the cameras look at."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from snowsplat.util.natural_order import natural_key

if TYPE_CHECKING:
    import pycolmap


_POINTS_SAMPLED = 5000  # number of points from which medians are computed
_PARALLEL = math.radians(10)  # axes within this angle meet nowhere
# The axes meet at a point that is in front of most cameras, by a share of the distance of their
# points; and that is nearer to the axes than this share of its distance from the cameras.
_MOST, _AHEAD, _NEAR = 0.75, 0.2, 0.5


@dataclass(frozen=True)
class Cameras:
    """The data of a model that are used here, in the world frame of SfM.

    The cameras are in the natural order of their names.
    """

    names: list[str]
    rotations: np.ndarray  # (N, 3, 3) of cam_from_world: the rows are the cameras' x, y, z axes
    centres: np.ndarray  # (N, 3)
    points: np.ndarray  # (P, 3), a sample of the points
    distances: np.ndarray  # (N,) median distance from a camera to its points; NaN without points

    @property
    def forward(self) -> np.ndarray:
        """(N, 3) the viewing directions."""
        return self.rotations[:, 2]

    @property
    def distance(self) -> float:
        """Median over the cameras of the distance to their points; at least a positive number.

        Without points, the median distance of the cameras from the median of their centres.
        """
        distances = self.distances[np.isfinite(self.distances)]
        if not len(distances):
            distances = np.linalg.norm(self.centres - np.median(self.centres, axis=0), axis=1)
        distance = float(np.median(distances))
        return distance if distance > 0 else 1.0

    @property
    def subject(self) -> np.ndarray:
        """(3,) the point where the optical axes meet; if they do not, the median of the points."""
        meeting = _meeting_point(self)
        if meeting is not None:
            return meeting
        if len(self.points):
            return np.median(self.points, axis=0)
        return np.median(self.centres, axis=0)


def read_cameras(model: pycolmap.Reconstruction) -> Cameras:
    """The cameras with a pose, and a sample of the points.

    Raises:
        ValueError: the model has no cameras.
    """
    images = [model.images[i] for i in model.reg_image_ids()]
    images.sort(key=lambda image: natural_key(image.name))
    if not images:
        raise ValueError("a model without cameras has no orientation")
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
    return Cameras([image.name for image in images], rotations, centres, points, distances)


def _meeting_point(cameras: Cameras) -> np.ndarray | None:
    """(3,) the point with the least sum of distances to the optical axes.

    None if the axes are nearly parallel, if they do not come close to one point, or if that point
    is behind the cameras. Computed by iteratively reweighted least squares.
    """
    axes, centres = cameras.forward, cameras.centres
    # (N, 3, 3) matrices that project a vector onto the plane perpendicular to an axis.
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < math.sin(_PARALLEL) ** 2:
        return None
    typical = cameras.distance
    weights = np.ones(len(axes))
    for _ in range(30):
        matrix = np.einsum("n,nij->ij", weights, across)
        point = np.linalg.solve(matrix, np.einsum("n,nij,nj->i", weights, across, centres))
        # The distances of the point from the axes.
        away = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centres), axis=1)
        weights = 1 / np.maximum(away, 0.01 * typical)
    ahead = np.einsum("ni,ni->n", point - centres, axes)  # the depth of the point in each camera
    is_met = (ahead > _AHEAD * typical).mean() > _MOST and np.median(away) < _NEAR * np.median(
        ahead
    )
    return point if is_met else None
