"""A person who walks through the room of the still life, for photos with something that moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from tests.scenes.depth import distances
from torch import Tensor

from snowsplat.scene.geometry import invert_rigid
from snowsplat.synthetic import textures as paint
from snowsplat.synthetic.photographer import RAYS, CentredLens, develop, tiles
from snowsplat.synthetic.scene import Scene, SceneObject
from snowsplat.synthetic.shapes import Ellipsoid, Frustum
from snowsplat.synthetic.still_life import FLOOR, LAMP

_DISTANCE = 1.25  # metres, from the centre of the table
_SPREAD = 0.7  # radians, standard deviation of the direction from the centre
_TROUSERS, _SHIRT, _SKIN = (0.13, 0.16, 0.30), (0.72, 0.16, 0.12), (0.72, 0.50, 0.38)


def chosen_photos(count: int, share: float, seed: int) -> list[int]:
    """``share`` of ``count`` photos, ascending; not those that ``--eval`` holds out (0, 8, …)."""
    candidates = [i for i in range(count) if i % 8]
    random = np.random.default_rng([seed, count])
    return sorted(random.choice(candidates, round(share * count), replace=False).tolist())


def passers_by(poses: Iterable[tuple[int, Tensor]], seed: int = 0) -> dict[int, Scene]:
    """For each photo, a scene that contains only the person, at another place each time.

    The person stands behind the table, as seen from the camera.

    Args:
        poses: numbers of photos, and their ``cam_from_world`` (3, 4) float64 in metres.
        seed: seed of the clothes and of the places.
    """
    return {number: _person(pose, number, seed) for number, pose in poses}


def _person(cam_from_world: Tensor, number: int, seed: int) -> Scene:
    clothes, places = np.random.default_rng(seed), np.random.default_rng([seed, number])
    x, y, _ = invert_rigid(cam_from_world)[:, 3].tolist()
    angle = math.atan2(-y, -x) + places.normal(0, _SPREAD)
    x, y = _DISTANCE * math.cos(angle), _DISTANCE * math.sin(angle)
    trousers = paint.plain((128, 64), _TROUSERS, clothes)
    stripes = paint.cloth((256, 128), 14, [_SHIRT, (0.85, 0.82, 0.75)], clothes)
    head = paint.plain((64, 64), _SKIN, clothes, stains=0.4)
    figure = [  # 1.7 m tall
        SceneObject(Frustum((x, y, FLOOR), 0.80, 0.13, 0.17), [trousers]),
        SceneObject(Frustum((x, y, FLOOR + 0.80), 0.62, 0.17, 0.22), [stripes]),
        SceneObject(Ellipsoid((x, y, FLOOR + 1.60), (0.10, 0.10, 0.13)), [head]),
    ]
    return Scene(figure, LAMP)


def photograph(
    scene: Scene,
    lens: CentredLens,
    cam_from_world: Tensor,
    random: np.random.Generator,
    passing: Scene | None = None,
) -> np.ndarray:
    """`snowsplat.synthetic.photographer.photograph` with someone who passes.

    ``passing``: more objects, which cast no shadow on the scene.
    """
    world_from_cam = invert_rigid(cam_from_world).numpy()
    rotation, origin = np.split(world_from_cam.astype(np.float32), [3], axis=1)
    spread = 1 / (lens.focal * RAYS)
    light = np.empty((lens.height, lens.width, 3), np.float32)
    for rows, columns, rays in tiles(lens):
        directions = rotation @ rays
        found = scene.radiance(origin, directions, spread)
        if passing is not None:
            near = distances(passing, origin, directions) < distances(scene, origin, directions)
            found = np.where(near, passing.radiance(origin, directions, spread), found)
        shape = (3, rows.stop - rows.start, RAYS, columns.stop - columns.start, RAYS)
        pixels = found.clip(0, 1).reshape(shape).mean(axis=(2, 4))
        light[rows, columns] = pixels.transpose(1, 2, 0)
    return develop(light, random)


def shooting(
    lens: CentredLens, poses: Sequence[Tensor], passing: Mapping[int, Scene]
) -> Callable[[Scene, int, np.random.Generator], np.ndarray]:
    """For `take_photos`; ``passing``: who is in only one photo, by the index of its pose."""
    return lambda scene, i, random: photograph(scene, lens, poses[i], random, passing.get(i))
