"""The video of a globe: the scene stands, is shaken, falls as snow, and is remembered.

The glass and the base do not move, except while the globe is shaken. The scene turns in it, as in
a globe with a music box. The last frame continues with the first one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from snowsplat.extras.globe import glass
from snowsplat.extras.globe.flakes import appearance
from snowsplat.extras.globe.layout import Arrangement
from snowsplat.extras.globe.physics import (
    LONGEST_STEP,
    REMEMBER_SECONDS,
    Snow,
    shake_acceleration,
    shake_offset,
)
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at
from snowsplat.scene.render import render

# Seconds from the start: when the globe is shaken, and when the scene is remembered.
SHAKE_AT = 1.3
REMEMBER_AT = 9.6
SECONDS = REMEMBER_AT + REMEMBER_SECONDS + 1.3

#: The camera: distance from the middle of the globe and its base, elevation (radians), and the
#: focal length as a multiple of the shorter side of the image.
DISTANCE, ELEVATION, FOCAL = 6.2, math.radians(9), 2.25
#: y of the middle of the globe and its base: the camera looks at this height.
MIDDLE = 0.04
#: Direction of the shaking in the frame of the camera: mostly to the sides.
SHAKE_DIRECTION = (0.94, 0.28, 0.20)
# If the cameras of the photos do not surround the scene, it turns by this angle to each side.
_SWING = math.radians(30)


@dataclass(frozen=True)
class GlobeVideo:
    """A video of a globe."""

    arrangement: Arrangement  # the Gaussians
    plate: np.ndarray | None  # (h, w) in 0..1: the text on the plate of the base; None: no plate
    width: int  # pixels
    height: int  # pixels
    fps: float  # frames per second

    @property
    def count(self) -> int:
        """The number of frames."""
        return max(1, round(SECONDS * self.fps))

    def frames(self) -> Iterator[np.ndarray]:
        """The frames, (height, width, 3) uint8. The same video has the same frames, bit by bit."""
        gaussians = self.arrangement.gaussians
        snow = Snow(gaussians.means.T.numpy())
        still = orbit_camera(0.0, self.width, self.height)
        backdrop = glass.draw(still, self.plate)
        for i in range(self.count):
            time = i / self.fps
            camera = orbit_camera(self._azimuth(time), self.width, self.height)
            with torch.no_grad():
                output = render(appearance(gaussians, snow), camera)
            picture = backdrop.around(output.image.numpy(), output.alpha.numpy())
            pixels = shake_offset(time - SHAKE_AT) * camera.fx / DISTANCE
            yield _shifted(picture, *(round(pixels * share) for share in SHAKE_DIRECTION[:2]))
            self._advance(snow, time, camera)

    def _advance(self, snow: Snow, time: float, camera: Camera) -> None:
        """Advance the simulation to the next frame."""
        steps = math.ceil(1 / self.fps / LONGEST_STEP - 1e-6)
        seconds = 1 / self.fps / steps
        direction = camera.world_from_cam[:, :3].numpy() @ np.array(SHAKE_DIRECTION)
        for j in range(steps):
            now = time + j * seconds
            if now <= REMEMBER_AT < now + seconds:
                snow.remember()
            x, y, z = (direction * shake_acceleration(now - SHAKE_AT)).tolist()
            snow.step(seconds, (x, y, z))

    def _azimuth(self, time: float) -> float:
        turn = 2 * math.pi * time / SECONDS
        return turn if self.arrangement.surrounded else _SWING * math.sin(turn)


def orbit_camera(azimuth: float, width: int, height: int) -> Camera:
    """A camera that looks at the globe; at azimuth 0, from the direction of the first photo."""
    level = DISTANCE * math.cos(ELEVATION)
    y = MIDDLE - DISTANCE * math.sin(ELEVATION)
    position = [level * math.sin(azimuth), y, -level * math.cos(azimuth)]
    points = (position, [0.0, MIDDLE, 0.0], [0.0, -1.0, 0.0])  # position, target, up
    pose = look_at(*(torch.tensor(point, dtype=torch.float64) for point in points))
    focal = FOCAL * min(width, height)
    return Camera(width, height, focal, focal, width / 2, height / 2, pose)


def _shifted(picture: np.ndarray, right: int, down: int) -> np.ndarray:
    """The picture moved by some pixels; its border is repeated."""
    if right == down == 0:
        return picture
    margin = max(abs(right), abs(down))
    padded = np.pad(picture, ((margin, margin), (margin, margin), (0, 0)), mode="edge")
    height, width = picture.shape[:2]
    return padded[margin - down :, margin - right :][:height, :width].copy()
