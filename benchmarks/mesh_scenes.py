"""Datasets of procedural scenes with exact poses, and true points on their surfaces."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from sfm_scenes import KINDS
from street import street
from street_dataset import walk_along
from torch import Tensor
from traced import DATASET_FROM_SCENE, depth_map, points_of, write_traced

from snowsplat.scene.geometry import look_at
from snowsplat.synthetic import textures as paint
from snowsplat.synthetic.photographer import Lens, walk
from snowsplat.synthetic.scene import Scene, SceneObject
from snowsplat.synthetic.shapes import Box
from snowsplat.synthetic.still_life import still_life

_PLAIN = KINDS["plain"]
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

    @cached_property
    def built(self) -> Scene:
        return self.build()

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


def _field() -> Scene:
    """A street on a meadow, for a drone."""
    grass = paint.plain((1024, 1024), (0.34, 0.42, 0.2), np.random.default_rng(0), stains=0.5)
    return street(30.0, 0, [SceneObject(Box((15, 0, -0.55), (160, 120, 1.0)), [grass])])


def _flight(count: int) -> list[Tensor]:
    """Three lanes over the field; the camera looks down and ahead, to the left and to the right."""
    random, poses = np.random.default_rng(count), []
    for i in range(count):
        lane, along = divmod(3 * i / count, 1.0)
        along = along if lane != 1 else 1 - along
        place = np.array([44 * along - 7, 13 * (lane - 1), 19.0]) + random.normal(0, 0.4, 3)
        gaze = np.array([(1, -1)[int(lane) % 2] * 6.0, 7 * (1 - lane), -19.0])
        poses.append(look_at(torch.from_numpy(place), torch.from_numpy(place + gaze), _UP))
    return poses


SCENES = {
    "table": lambda: Procedural(still_life, walk(72, 0), 1.9, 0.85),
    "room": lambda: Procedural(still_life, _outward(72), 4.5, 0.62),
    "plain": lambda: Procedural(
        lambda: KINDS["plain"].build(0, 60), KINDS["plain"].path(60, 0), 4.5
    ),
    "street": lambda: Procedural(lambda: street(9.6), walk_along(9.6, 96, 0), 9.0),
    "drone": lambda: Procedural(_field, _flight(45), 40.0, 0.75),
}


def write_dataset(folder: Path, scene: Procedural, width: int) -> None:
    """Photos, poses and noisy points in the format of COLMAP, unless they exist."""
    if not (folder / "sparse").exists():
        write_traced(
            folder, lambda: scene.built, scene.lens(width), scene.poses, reach=2 * scene.reach
        )


def true_points(scene: Procedural, width: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random points (P, 3) on the surfaces that the photos show.

    The first ones are where a camera could show them from within the reach. A photo may show them
    from farther away: a mesh there is right. The second ones are a part of them: a photo shows them
    from within the reach, and another one shows them, too.
    """
    lens = scene.lens(width)
    depths = [depth_map(scene.built, lens, pose) for pose in scene.poses]
    random = np.random.default_rng(1)
    found = []
    for pose, depth in zip(scene.poses, depths, strict=True):
        rows, columns = np.nonzero(np.isfinite(depth))
        chosen = random.choice(len(rows), min(len(rows), count // len(depths)), replace=False)
        found.append(points_of(lens, pose, depth, rows[chosen], columns[chosen]))
    points = np.concatenate(found)
    inside, near, shown = shown_by(points, scene, lens, depths)
    return points[inside > 0], points[(near > 0) & (shown > 1)]


def shown_by(
    points: np.ndarray,
    scene: Procedural,
    lens: Lens,
    depths: Sequence[np.ndarray],
    same: float = _SAME_DEPTH,
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
        shown = inside & (np.abs(seen / z - 1) < same)
        near = z < scene.reach
        count += np.stack([inside & near, shown & near, shown])
    return count
