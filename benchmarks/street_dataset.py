"""A dataset of the procedural street: photos of a walk, exact poses, and points on the surfaces."""

import math
from pathlib import Path

import numpy as np
import torch
from street import street
from torch import Tensor
from traced import write_traced

from snowsplat.scene.geometry import look_at
from snowsplat.sfm.progress import Report, silent
from snowsplat.synthetic.photographer import Lens, roll

#: Metres of the street per photo.
_PITCH = 0.16
_FOCAL = 0.8  # times the width of a photo
_LANE = 1.3  # metres between the path and the middle of the road
# Degrees between the direction of the walk and that of a photo, to the left; they are repeated.
_GAZES = (20.0, -50.0, 80.0, -15.0, 50.0, -85.0)
_POINT_ERROR = 0.01  # metres, standard deviation, as in structure from motion
_FAR = 30.0  # metres; more distant points are left out


def write_street_dataset(
    folder: Path | str,
    n_views: int = 600,
    width: int = 240,
    height: int = 160,
    seed: int = 0,
    points_per_view: int = 100,
    report: Report = silent,
) -> Path:
    """Photograph a street on a walk to its end and back, and write a dataset with a COLMAP model.

    The street is 0.16 m long for each photo. The points are random ones on the surfaces that the
    photos show within 30 m. Equal arguments produce equal files;
    existing photos are kept.

    Returns:
        the folder.
    """
    folder, length = Path(folder), _PITCH * n_views
    lens = Lens(width, height, _FOCAL * width, (0.0, 0.0, 0.0, 0.0))
    write_traced(
        folder,
        lambda: street(length, seed),
        lens,
        walk_along(length, n_views, seed),
        seed=seed,
        points=points_per_view,
        error=_POINT_ERROR,
        reach=_FAR,
        report=report,
    )
    return folder


def walk_along(length: float, count: int, seed: int) -> list[Tensor]:
    """``cam_from_world`` of a hand-held camera: along one side of the road, and back on the other.

    The photos look ahead and at the façades of both sides.
    """
    random = np.random.default_rng([seed, count])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    poses = []
    for i in range(count):
        back = 2 * i >= count
        share = 2 * i / count
        x = length * (2 - share if back else share)
        position = np.array([x, _LANE if back else -_LANE, 1.6]) + random.normal(
            0, (0.03, 0.25, 0.05)
        )
        yaw = math.radians(_GAZES[i % len(_GAZES)] + random.normal(0, 6)) + math.pi * back
        rise = math.radians(random.uniform(2, 12))
        gaze = np.array([math.cos(yaw), math.sin(yaw), math.tan(rise)])
        pose = look_at(torch.from_numpy(position), torch.from_numpy(position + gaze), up)
        poses.append(roll(pose, random.normal(0, 0.03)))
    return poses
