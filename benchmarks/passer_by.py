"""A person who walks through the room of the still life, for photos with something that moves."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from torch import Tensor
from traced import distances

from snowsplat.scene.geometry import invert_rigid
from snowsplat.synthetic import textures as paint
from snowsplat.synthetic.photographer import CentredLens, photograph
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


class _Passed(Scene):
    """A scene with more objects, which cast no shadow on it."""

    def __init__(self, scene: Scene, passing: Scene) -> None:
        self._scenes = scene, passing

    def radiance(self, origins: np.ndarray, directions: np.ndarray, spread: float) -> np.ndarray:
        scene, passing = (each.radiance(origins, directions, spread) for each in self._scenes)
        far, near = (distances(each, origins, directions) for each in self._scenes)
        return np.where(near < far, passing, scene)


def shooting(
    lens: CentredLens, poses: Sequence[Tensor], passing: Mapping[int, Scene]
) -> Callable[[Scene, int, np.random.Generator], np.ndarray]:
    """For `take_photos`; ``passing``: who is in only one photo, by the index of its pose."""

    def shoot(scene: Scene, i: int, random: np.random.Generator) -> np.ndarray:
        shown = _Passed(scene, passing[i]) if i in passing else scene
        return photograph(shown, lens, poses[i], random)

    return shoot
