"""A dataset of the procedural street: photos of a walk, exact poses, and points on the surfaces."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from street import HALF_WIDTH, street
from tests.scenes.depth import distances
from torch import Tensor

from snowsplat.data.colmap.model import write_posed
from snowsplat.data.lens.models import lens_of
from snowsplat.scene.geometry import compose_rigid, invert_rigid, look_at
from snowsplat.sfm.progress import Report, silent
from snowsplat.synthetic.photographer import Lens, roll, take_photos
from snowsplat.synthetic.scene import Scene

#: Metres of the street per photo.
_PITCH = 0.16
_FOCAL = 0.8  # times the width of a photo
_LANE = 1.3  # metres between the path and the middle of the road
# Degrees between the direction of the walk and that of a photo, to the left; they are repeated.
_GAZES = (20.0, -50.0, 80.0, -15.0, 50.0, -85.0)
_POINT_ERROR = 0.01  # metres, standard deviation, as in structure from motion
_FAR = 30.0  # metres; more distant points are left out
#: x right, y down, z forward, as in other datasets; in the scene, z is up.
DATASET_FROM_SCENE = torch.tensor(
    [[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0]], dtype=torch.float64
)


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
    photos show, without the sky and the painted walls. Equal arguments produce equal files;
    existing photos are kept.

    Returns:
        the folder.
    """
    folder = Path(folder)
    lens = Lens(width, height, _FOCAL * width, (0.0, 0.0, 0.0, 0.0))
    length = _PITCH * n_views
    poses = walk_along(length, n_views, seed)
    scene = street(length, seed)
    truth = take_photos(folder / "images", lambda: scene, lens, poses, seed, report)
    random = np.random.default_rng(seed)
    xyz, rgb, posed = [], [], []
    pinhole = lens_of("PINHOLE", width, height, lens.params[:4])
    for name, pose in truth.poses.items():
        with Image.open(folder / "images" / name) as photo:
            found = _points(scene, length, lens, pose, np.asarray(photo), points_per_view, random)
        xyz.append(found[0])
        rgb.append(found[1])
        moved = compose_rigid(pose, invert_rigid(DATASET_FROM_SCENE))
        posed.append((name, pinhole, moved))
    turned = np.concatenate(xyz) @ DATASET_FROM_SCENE[:, :3].numpy().T
    write_posed(folder / "sparse" / "0", posed, turned, np.concatenate(rgb))
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


def _points(
    scene: Scene,
    length: float,
    lens: Lens,
    cam_from_world: Tensor,
    photo: np.ndarray,
    count: int,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """At most ``count`` points (P, 3) at random pixels, and their colours (P, 3)."""
    world_from_cam = invert_rigid(cam_from_world).numpy()
    rotation, origin = np.split(world_from_cam.astype(np.float32), [3], axis=1)
    pixels = random.uniform(0, (lens.width, lens.height), (count, 2))
    directions = rotation @ lens.directions(pixels.T).astype(np.float32)
    distance = distances(scene, origin, directions)
    xyz = (origin + distance * directions).T
    x, y = xyz[:, 0], xyz[:, 1]
    real = (distance < _FAR) & (np.abs(y) < HALF_WIDTH + 1) & (x > -8) & (x < length + 8)
    columns, rows = pixels[real].astype(int).T
    noise = random.normal(0, _POINT_ERROR, (int(real.sum()), 3))
    return xyz[real].astype(np.float64) + noise, photo[rows, columns]
