"""Datasets of ray-traced scenes: photos, exact poses, and points as structure from motion has them.

`depth_map` and `distances` are exact, too.
"""

import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.scenes.depth import depth_map, distances

from snowsplat.data.colmap.model import write_posed
from snowsplat.data.lens.models import lens_of
from snowsplat.scene.geometry import compose_rigid, invert_rigid
from snowsplat.sfm.progress import Report, silent
from snowsplat.synthetic.photographer import CentredLens, take_photos
from snowsplat.synthetic.scene import Scene

__all__ = ["DATASET_FROM_SCENE", "depth_map", "distances", "points_of", "write_traced"]

#: x right, y down, z forward, as in other datasets; in the scene, z is up.
DATASET_FROM_SCENE = torch.tensor(
    [[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0]], dtype=torch.float64
)


def points_of(
    lens: CentredLens, pose: Tensor, depth: np.ndarray, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """(P, 3) float64: the surface at the centres of these pixels, in the dataset's frame."""
    rays = lens.directions(np.stack([columns + 0.5, rows + 0.5]))
    points = rays / rays[2] * depth[rows, columns]
    world_from_cam = compose_rigid(DATASET_FROM_SCENE, invert_rigid(pose)).numpy()
    return points.T @ world_from_cam[:, :3].T + world_from_cam[:, 3]


def write_traced(
    folder: Path,
    build: Callable[[], Scene],
    lens: CentredLens,
    poses: Sequence[Tensor],
    *,
    seed: int = 0,
    points: int = 120,
    error: float = 0.004,
    reach: float = math.inf,
    report: Report = silent,
    shoot: Callable[[Scene, int, np.random.Generator], np.ndarray] | None = None,
) -> None:
    """Photos without lens distortion, and a COLMAP model; existing photos are kept.

    Args:
        build: makes the scene.
        points: per photo, at random pixels.
        error: of their positions in metres, standard deviation.
        reach: metres; points are nearer than this to the photo.
        seed, report, shoot: as for `take_photos`; ``seed`` is that of the points, too.
    """
    scene = build()
    truth = take_photos(folder / "images", lambda: scene, lens, poses, seed, report, shoot)
    random = np.random.default_rng(seed)
    xyz, rgb, posed = [], [], []
    pinhole = lens_of("PINHOLE", lens.width, lens.height, lens.params[:4])
    for name, pose in truth.poses.items():
        with Image.open(folder / "images" / name) as photo:
            pixels = np.asarray(photo)
        depth = depth_map(scene, lens, pose)
        rows, columns = (random.integers(0, n, points) for n in (lens.height, lens.width))
        near = depth[rows, columns] < reach
        own = points_of(lens, pose, depth, rows[near], columns[near])
        xyz.append(own + random.normal(0, error, own.shape))
        rgb.append(pixels[rows[near], columns[near]])
        posed.append((name, pinhole, compose_rigid(pose, invert_rigid(DATASET_FROM_SCENE))))
    write_posed(folder / "sparse" / "0", posed, np.concatenate(xyz), np.concatenate(rgb))
