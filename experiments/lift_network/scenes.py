"""Random scenes of our ray tracer: two photos of each, with the true depth.

A scene is a room with a floor, walls, and three to six boxes, balls and truncated cones. A photo is
taken from about 1.5 m above the floor. The second photo is taken up to 0.3 m beside the first one
and looks at the same point. Each of them is the second view of the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at
from snowsplat.synthetic.photographer import Lens, depth_map, photograph
from snowsplat.synthetic.scene import Lamp, Scene, SceneObject
from snowsplat.synthetic.shapes import Box, Ellipsoid, Frustum
from snowsplat.synthetic.textures import noise

#: "A": checkers and noise. "B": stripes and dots.
Family = Literal["A", "B"]
SIZE = 96  # pixels, width and height of a photo
FOCAL = 90.0  # pixels, of the training photos: 56° field of view
OTHER_FOCAL = 135.0  # pixels: 39°
# Along each side of a texture. Objects are about 25 pixels wide.
_WALL_TEXELS, _OBJECT_TEXELS = 64, 24
_ROOM = (7.0, 7.0, 3.0)  # metres


@dataclass(frozen=True)
class Shots:
    """N photos. Photo 2k and photo 2k + 1 show the same scene.

    Attributes:
        images: (N, H, W, 3) uint8 sRGB.
        depths: (N, H, W) float32, camera z in metres.
        poses: (N, 3, 4) float64 ``cam_from_world``.
        focal: pixels, of all photos.
    """

    images: Tensor
    depths: Tensor
    poses: Tensor
    focal: float

    def __len__(self) -> int:
        return len(self.images)

    def camera(self, i: int) -> Camera:
        height, width = self.depths.shape[1:]
        return Camera(width, height, self.focal, self.focal, width / 2, height / 2, self.poses[i])

    def image(self, i: int) -> Tensor:
        """(H, W, 3) float32 in 0..1."""
        return self.images[i].float() / 255

    def first(self, count: int) -> Shots:
        """The first ``count`` photos."""
        return Shots(self.images[:count], self.depths[:count], self.poses[:count], self.focal)


def make_shots(cache: Path, scenes: int, family: Family, focal: float, seed: int) -> Shots:
    """Two photos of each of ``scenes`` scenes, ray traced once and then read from ``cache``."""
    path = cache / f"{family}_{focal:g}_{seed}_{scenes}.pt"
    if not path.exists():
        cache.mkdir(parents=True, exist_ok=True)
        lens = Lens(SIZE, SIZE, focal, (0.0, 0.0, 0.0, 0.0))
        images, depths, poses = [], [], []
        for i in range(scenes):
            random = np.random.default_rng([seed, i])
            scene = random_scene(family, random)
            for pose in _two_poses(random):
                images.append(photograph(scene, lens, pose, random))
                depths.append(depth_map(scene, lens, pose))
                poses.append(pose)
        stacked = [torch.from_numpy(np.stack(part)) for part in (images, depths)]
        torch.save([*stacked, torch.stack(poses)], path)
    return Shots(*torch.load(path), focal)


def random_scene(family: Family, random: np.random.Generator) -> Scene:
    """A room with three to six objects on its floor, in the textures of a family."""
    room = Box((0, 0, _ROOM[2] / 2), _ROOM, inside=True)
    walls = [_texture(family, _WALL_TEXELS, random.uniform(3, 8), random) for _ in range(6)]
    objects = [SceneObject(room, walls)]
    for _ in range(random.integers(3, 7)):
        x, y = random.uniform(-1.3, 1.3), random.uniform(-1.3, 2.2)
        size = random.uniform(0.25, 0.65)
        kind = random.integers(0, 3)
        shape: Box | Ellipsoid | Frustum
        if kind == 0:
            tall = size * random.uniform(0.7, 2.0)
            shape = Box((x, y, tall / 2), (size, size, tall), random.uniform(0, math.pi))
        elif kind == 1:
            radius = 0.6 * size
            shape = Ellipsoid((x, y, radius), (radius, radius, radius))
        else:
            tall, top = size * random.uniform(1.0, 2.5), size * random.uniform(0.1, 0.5)
            shape = Frustum((x, y, 0), tall, 0.5 * size, top)
        paint = [
            _texture(family, _OBJECT_TEXELS, random.uniform(2, 5), random) for _ in shape.sizes
        ]
        objects.append(SceneObject(shape, paint))
    lamp = Lamp(
        (random.uniform(-1.5, 1.5), random.uniform(-1.5, 1.0), 2.9), (0.8, 0.8), 4.0, ambient=0.7
    )
    return Scene(objects, lamp)


def _two_poses(random: np.random.Generator) -> tuple[Tensor, Tensor]:
    """``cam_from_world`` of two photos, from the side of the room at y < 0."""
    position = np.array(
        [random.uniform(-0.8, 0.8), random.uniform(-3.2, -2.4), random.uniform(1.1, 1.9)]
    )
    target = np.array(
        [random.uniform(-0.4, 0.4), random.uniform(0.0, 0.8), random.uniform(0.2, 0.7)]
    )
    aside = position + np.array([random.choice([-1, 1]) * random.uniform(0.15, 0.3), 0, 0])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    first, second = (
        look_at(torch.from_numpy(at), torch.from_numpy(target), up) for at in (position, aside)
    )
    return first, second


def _texture(family: Family, texels: int, cells: float, random: np.random.Generator) -> np.ndarray:
    """sRGB (texels, texels, 3) in two random colours, with ``cells`` periods along a side."""
    size = (texels, texels)
    first, second = random.uniform(0.1, 0.95, (2, 3)).astype(np.float32)
    u = ((np.arange(texels) + 0.5) / texels).astype(np.float32)
    kind = random.integers(0, 2)
    if family == "A" and kind == 0:  # a checkerboard
        even = (np.floor(u[None] * cells) + np.floor(u[:, None] * cells)) % 2
        share = even.astype(np.float32)
    elif family == "A":  # value noise
        share = (0.5 + 1.2 * noise(size, (cells, cells), 3, random)).clip(0, 1)
    elif kind == 0:  # stripes in a random direction
        angle = random.uniform(0, math.pi)
        across = math.cos(angle) * u[None] + math.sin(angle) * u[:, None]
        share = (0.5 + 4 * np.sin(2 * math.pi * cells * across)).clip(0, 1)
    else:  # dots on a grid
        x, y = (np.abs((axis * cells) % 1 - 0.5) for axis in (u[None], u[:, None]))
        share = (8 * (0.3 - np.hypot(x, y)) + 0.5).clip(0, 1)
    return (first + share[..., None] * (second - first)).astype(np.float32)
