"""Datasets of procedural scenes with exact poses, and true points on their surfaces."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))

from street import street
from street_dataset import DATASET_FROM_SCENE, walk_along
from tests.scenes.depth import depth_map

from snowsplat.data.colmap.model import write_posed
from snowsplat.data.lens.models import lens_of
from snowsplat.scene.geometry import compose_rigid, invert_rigid, look_at
from snowsplat.synthetic.photographer import Lens, take_photos, walk
from snowsplat.synthetic.scene import Scene
from snowsplat.synthetic.still_life import still_life

_POINT_ERROR = 0.004  # metres: of the points of the dataset, as in structure from motion
_POINTS = 120  # of the dataset, per photo
_SAME_DEPTH = 0.01  # a photo shows a point if its depth there differs by less than this share
_UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


@dataclass(frozen=True)
class Procedural:
    """A scene, the cameras of its photos, and the part of it that a mesh should have.

    Attributes:
        reach: metres; surfaces that no photo shows from nearer do not count.
    """

    build: Callable[[], Scene]
    poses: Sequence[Tensor]
    reach: float
    focal: float = 0.8  # times the width of a photo

    def lens(self, width: int) -> Lens:
        return Lens(width, 3 * width // 4, self.focal * width, (0.0, 0.0, 0.0, 0.0))


def _outward(count: int) -> list[Tensor]:
    """Cameras that walk around the table and look at the walls, the floor and the furniture."""
    random = np.random.default_rng(count)
    poses = []
    for i in range(count):
        angle = 2 * math.pi * i / count + random.normal(0, 0.02)
        place = np.array([0.95 * math.cos(angle), 0.95 * math.sin(angle), 0.55 + 0.3 * (i % 2)])
        gaze = angle + (0.5, -0.5, 0.0)[i % 3]
        away = np.array([math.cos(gaze), math.sin(gaze), (-0.35, 0.05)[i % 2]])
        poses.append(look_at(torch.from_numpy(place), torch.from_numpy(place + away), _UP))
    return poses


SCENES = {
    "table": lambda: Procedural(still_life, walk(72, 0), 1.9, 0.85),
    "room": lambda: Procedural(still_life, _outward(72), 4.5, 0.62),
    "street": lambda: Procedural(lambda: street(9.6), walk_along(9.6, 96, 0), 9.0),
}


def write_dataset(folder: Path, scene: Procedural, width: int) -> Scene:
    """Photos, poses and noisy points in the format of COLMAP; existing photos are kept."""
    lens, built = scene.lens(width), scene.build()
    truth = take_photos(folder / "images", lambda: built, lens, scene.poses)
    random = np.random.default_rng(0)
    xyz, rgb, posed = [], [], []
    pinhole = lens_of("PINHOLE", lens.width, lens.height, lens.params[:4])
    for name, pose in truth.poses.items():
        with Image.open(folder / "images" / name) as photo:
            pixels = np.asarray(photo)
        depth = depth_map(built, lens, pose)
        rows = random.integers(0, lens.height, _POINTS)
        columns = random.integers(0, lens.width, _POINTS)
        seen = depth[rows, columns] < 2 * scene.reach
        points = _points(lens, pose, depth, rows[seen], columns[seen])
        xyz.append(points + random.normal(0, _POINT_ERROR, points.shape))
        rgb.append(pixels[rows[seen], columns[seen]])
        moved = compose_rigid(pose, invert_rigid(DATASET_FROM_SCENE))
        posed.append((name, pinhole, moved))
    write_posed(folder / "sparse" / "0", posed, np.concatenate(xyz), np.concatenate(rgb))
    return built


def true_points(
    built: Scene, scene: Procedural, width: int, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Random points (P, 3) on the surfaces that the photos show.

    The first ones are where a camera could show them from within the reach. A photo may show them
    from farther away: a mesh there is right. The second ones are a part of them: a photo shows them
    from within the reach, and another one shows them, too.
    """
    lens = scene.lens(width)
    depths = [depth_map(built, lens, pose) for pose in scene.poses]
    random = np.random.default_rng(1)
    found = []
    for pose, depth in zip(scene.poses, depths, strict=True):
        rows, columns = np.nonzero(np.isfinite(depth))
        chosen = random.choice(len(rows), min(len(rows), count // len(depths)), replace=False)
        found.append(_points(lens, pose, depth, rows[chosen], columns[chosen]))
    points = np.concatenate(found)
    inside, near, shown = _views(points, scene, lens, depths)
    return points[inside > 0], points[(near > 0) & (shown > 1)]


def _views(
    points: np.ndarray, scene: Procedural, lens: Lens, depths: Sequence[np.ndarray]
) -> np.ndarray:
    """(3, P): the photos in whose picture each point is within the reach, hidden or not; those
    that show it from within the reach; and those that show it. Points are in the dataset's frame.
    """
    own = points @ DATASET_FROM_SCENE[:, :3].numpy()  # the inverse rotation
    count = np.zeros((3, len(points)), int)
    for pose, depth in zip(scene.poses, depths, strict=True):
        camera = own @ pose[:, :3].numpy().T + pose[:, 3].numpy()
        z = np.maximum(camera[:, 2], 1e-6)
        x = (camera[:, 0] / z * lens.focal + lens.width / 2).astype(int)
        y = (camera[:, 1] / z * lens.focal + lens.height / 2).astype(int)
        inside = (camera[:, 2] > 0.05) & (x >= 0) & (y >= 0) & (x < lens.width) & (y < lens.height)
        seen = depth[y.clip(0, lens.height - 1), x.clip(0, lens.width - 1)]
        shown = inside & (np.abs(seen / z - 1) < _SAME_DEPTH)
        near = z < scene.reach
        count += np.stack([inside & near, shown & near, shown])
    return count


def _points(
    lens: Lens, pose: Tensor, depth: np.ndarray, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """(P, 3) float64: the surface at the centres of these pixels, in the dataset's frame."""
    rays = lens.directions(np.stack([columns + 0.5, rows + 0.5]))
    points = rays / rays[2] * depth[rows, columns]
    world_from_cam = compose_rigid(DATASET_FROM_SCENE, invert_rigid(pose)).numpy()
    return points.T @ world_from_cam[:, :3].T + world_from_cam[:, 3]
