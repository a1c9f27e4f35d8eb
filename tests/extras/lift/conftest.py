"""A small ray-traced scene with true depth: two photos of a ball and a box in a room."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at
from snowsplat.synthetic.photographer import Lens, photograph
from snowsplat.synthetic.scene import Lamp, Scene, SceneObject
from snowsplat.synthetic.shapes import Box, Ellipsoid
from snowsplat.synthetic.textures import noise

from ...scenes.depth import depth_map

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0


@dataclass(frozen=True)
class Shot:
    """A photo (H, W, 3) in 0..1, its true depth (H, W), and its camera."""

    photo: Tensor
    depth: Tensor
    camera: Camera


def paint(random: np.random.Generator) -> np.ndarray:
    first, second = random.uniform(0.2, 0.9, (2, 3)).astype(np.float32)
    share = (0.5 + 1.2 * noise((48, 48), (6, 6), 2, random)).clip(0, 1)
    return (first + share[..., None] * (second - first)).astype(np.float32)


@pytest.fixture(scope="session")
def shots() -> tuple[Shot, Shot]:
    """Two photos, 0.25 m apart; read-only for the tests."""
    random = np.random.default_rng(0)
    room = SceneObject(Box((0, 0, 1.5), (5, 5, 3), inside=True), [paint(random) for _ in range(6)])
    ball = SceneObject(Ellipsoid((-0.35, 0.1, 0.4), (0.4, 0.4, 0.4)), [paint(random)])
    box = SceneObject(Box((0.6, 0.7, 0.5), (0.5, 0.5, 1.0), 0.5), [paint(random) for _ in range(6)])
    scene = Scene([room, ball, box], Lamp((0.5, -0.5, 2.9), (0.8, 0.8), 3.0, 0.7))
    lens = Lens(WIDTH, HEIGHT, FOCAL, (0.0, 0.0, 0.0, 0.0))
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    target = torch.tensor([0.0, 0.2, 0.4], dtype=torch.float64)
    found = []
    for x in (0.0, 0.25):
        pose = look_at(torch.tensor([x, -2.2, 1.3], dtype=torch.float64), target, up)
        pixels = photograph(scene, lens, pose, random)
        camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)
        depth = torch.from_numpy(depth_map(scene, lens, pose))
        found.append(Shot(torch.from_numpy(pixels).float() / 255, depth, camera))
    return found[0], found[1]
