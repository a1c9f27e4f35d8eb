"""The depth of a photograph: exact for a wall and a ball; infinite where nothing is."""

from __future__ import annotations

import numpy as np
import torch

from snowsplat.scene.geometry import look_at
from snowsplat.synthetic.photographer import Lens
from snowsplat.synthetic.scene import Lamp, Scene, SceneObject
from snowsplat.synthetic.shapes import Box, Ellipsoid

from ..scenes.depth import depth_map

WHITE = np.full((8, 8, 3), 0.8, np.float32)
LAMP = Lamp((0.0, 0.0, 3.0), (0.5, 0.5), 1.0, 0.5)


def test_depths_of_a_wall_and_a_ball():
    wall = SceneObject(Box((0, 5, 0), (4, 2, 4)), [WHITE])  # its front is 4 m away
    ball = SceneObject(Ellipsoid((0, 3, 0), (0.5, 0.5, 0.5)), [WHITE])
    position, target, up = (
        torch.tensor(xyz, dtype=torch.float64) for xyz in ((0, 0, 0), (0, 1, 0), (0, 0, 1))
    )
    lens = Lens(101, 81, 60.0, (0.0, 0.0, 0.0, 0.0))
    depth = depth_map(Scene([wall, ball], LAMP), lens, look_at(position, target, up))
    assert depth.shape == (81, 101)
    assert depth.dtype == np.float32
    assert abs(depth[40, 50] - 2.5) < 1e-3
    x, y = np.meshgrid(np.arange(101) - 50, np.arange(81) - 40)
    outside = np.hypot(x, y) > 60 * 0.5 / np.sqrt(3**2 - 0.5**2) + 1
    on_wall = outside & (np.maximum(np.abs(x), np.abs(y)) < 60 * 2 / 4 - 1)
    assert np.abs(depth[on_wall] - 4).max() < 1e-3  # z, not the length of the ray
    assert np.isinf(depth[0, 0])
