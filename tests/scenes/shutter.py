"""Photos with a large aperture, a moving camera exposure, and people who pass."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from snowsplat.scene.geometry import invert_rigid
from snowsplat.synthetic.lens import CentredLens
from snowsplat.synthetic.photographer import RAYS, develop, tiles
from snowsplat.synthetic.scene import Scene

from .depth import distances

_GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples are evenly distributed in time


@dataclass(frozen=True)
class Shutter:
    """A thin lens, and an exposure that takes time.

    A point at the distance z is a disc in the photo, with a diameter of
    aperture · focal · |1 / focus − 1 / z| pixels.
    """

    aperture: float  # diameter of the lens, metres
    focus: float  # distance of the plane that is sharp, along the optical axis, metres
    motion: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of what passes, metres per exposure
    samples: int = 16  # positions on the lens; a pixel has one ray from each

    def positions(self) -> np.ndarray:
        """(samples, 2) float32 on the lens, evenly distributed, in metres from its middle."""
        i = np.arange(self.samples) + 0.5
        radius, angle = np.sqrt(i / self.samples), i * (math.pi * (3 - math.sqrt(5)))
        disc = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        return (0.5 * self.aperture * disc).astype(np.float32)


def photograph(
    scene: Scene,
    lens: CentredLens,
    cam_from_world: Tensor,
    random: np.random.Generator,
    passing: Scene | None = None,
    shutter: Shutter | None = None,
) -> np.ndarray:
    """`snowsplat.synthetic.photographer.photograph` with what moves.

    Args:
        passing: more objects, which cast no shadow on the scene.
        shutter: None: everything is sharp.
    """
    world_from_cam = invert_rigid(cam_from_world).numpy()
    rotation, origin = np.split(world_from_cam.astype(np.float32), [3], axis=1)
    spread = 1 / (lens.focal * RAYS)
    light = np.empty((lens.height, lens.width, 3), np.float32)

    def seen(origin: np.ndarray, rays: np.ndarray, moved: np.ndarray | float = 0.0) -> np.ndarray:
        directions = rotation @ rays
        found = scene.radiance(origin, directions, spread)
        if passing is not None:
            start = origin - moved
            near = distances(passing, start, directions) < distances(scene, origin, directions)
            found = np.where(near, passing.radiance(start, directions, spread), found)
        return found.clip(0, 1)

    for rows, columns, rays in tiles(lens):
        shape = (3, rows.stop - rows.start, RAYS, columns.stop - columns.start, RAYS)
        if shutter is None:
            pixels = seen(origin, rays).reshape(shape).mean(axis=(2, 4))
        else:
            # All rays through one position on the lens have one origin, as those of a pinhole.
            total = np.zeros((3, shape[1] * shape[3]), np.float32)
            for i, position in enumerate(shutter.positions()):
                own = rays.reshape(shape)[:, :, i // RAYS % RAYS, :, i % RAYS].reshape(3, -1)
                offset = np.array([[*position, 0.0]], np.float32).T
                own = own * (shutter.focus / own[2]) - offset
                moved = np.array([shutter.motion], np.float32).T * (i * _GOLDEN % 1 - 0.5)
                own = own / np.sqrt((own * own).sum(axis=0))
                total += seen(origin + rotation @ offset, own, moved)
            pixels = (total / shutter.samples).reshape(3, shape[1], shape[3])
        light[rows, columns] = pixels.transpose(1, 2, 0)
    return develop(light, random)


def shooting(
    lens: CentredLens,
    poses: Sequence[Tensor],
    passing: Mapping[int, Scene],
    shutter: Shutter | None = None,
) -> Callable[[Scene, int, np.random.Generator], np.ndarray]:
    """For `take_photos`; ``passing``: what is in only one photo, by the index of its pose."""
    return lambda scene, i, random: photograph(
        scene, lens, poses[i], random, passing.get(i), shutter
    )
