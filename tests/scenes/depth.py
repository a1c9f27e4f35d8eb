"""The depth of a ray-traced scene: exact, as tests and benchmarks compare it."""

import numpy as np
from torch import Tensor

from snowsplat.scene.geometry import invert_rigid
from snowsplat.synthetic.photographer import Lens
from snowsplat.synthetic.scene import Scene


def distances(scene: Scene, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distances (R,) float32 to the first hits along rays, in metres; infinite without a hit.

    ``origins`` and ``directions``: see `Scene.radiance`.
    """
    return scene.nearest(origins, directions, scene.candidates(origins, directions))[0]


def depth_map(scene: Scene, lens: Lens, cam_from_world: Tensor) -> np.ndarray:
    """(H, W) float32: camera z at the centres of the pixels, metres; infinite without a hit."""
    world_from_cam = invert_rigid(cam_from_world).numpy()
    rotation, origin = np.split(world_from_cam.astype(np.float32), [3], axis=1)
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = lens.directions(np.stack([x.ravel(), y.ravel()])).astype(np.float32)
    z = distances(scene, origin, rotation @ rays) * rays[2]
    return z.reshape(lens.height, lens.width)
