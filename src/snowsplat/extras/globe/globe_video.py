"""The video of a globe: the scene stands, is shaken, falls as snow, and is remembered.

The glass and the base do not move, except while the globe is shaken. The scene turns in it, as in
a globe with a music box. The last frame continues with the first one.

A Gaussian that is snow is small, opaque, brighter, and turned. The page does the same on the GPU
(`web/splats.vert`).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from snowsplat.extras.globe import glass
from snowsplat.extras.globe.layout import Arrangement
from snowsplat.extras.globe.physics import (
    FLAKE,
    LONGEST_STEP,
    REMEMBER_SECONDS,
    Snow,
    random_numbers,
    shake_acceleration,
    shake_offset,
)
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at, quat_product
from snowsplat.scene.render import render
from snowsplat.scene.sh_constants import SH_C0

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
#: The colour of a flake: that of the Gaussian with its largest channel at 1, but at most this many
#: times as bright, mixed with a share of white.
BRIGHTER = 2.5
WHITE = 0.58
#: Opacity of a flake, unless the Gaussian is more opaque.
OPAQUE = 0.9


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


def appearance(gaussians: Gaussians, snow: Snow) -> Gaussians:
    """The Gaussians of the scene, in the frame of the globe, in a state of the simulation ``snow``,
    which has them in the same order. If they all stand, the result equals ``gaussians``.
    """
    morph = torch.from_numpy(snow.morph)
    low, high = (math.log(radius) for radius in FLAKE)
    scales = gaussians.log_scales
    opacities = gaussians.opacities
    colors = gaussians.base_colors
    bright = colors / colors.amax(1, keepdim=True).clamp(1.0 / BRIGHTER, 1.0)
    change = bright + WHITE * (1.0 - bright) - colors
    half = 0.5 * snow.angle
    spin = np.concatenate([np.cos(half)[None], np.sin(half) * spin_axes(len(half))])
    return replace(
        gaussians,
        means=torch.from_numpy(snow.position.T.copy()),
        log_scales=scales + morph[:, None] * (scales.clamp(low, high) - scales),
        quats=quat_product(torch.from_numpy(spin.T.copy()), gaussians.rotations),
        opacity_logits=torch.where(
            morph > 0,
            (opacities + morph * (opacities.clamp_min(OPAQUE) - opacities)).logit(1e-6),
            gaussians.opacity_logits,
        ),
        sh_dc=gaussians.sh_dc + (morph[:, None] * change / SH_C0)[:, None],
        sh_rest=gaussians.sh_rest * (1.0 - morph)[:, None, None],
    )


def spin_axes(count: int) -> np.ndarray:
    """(3, count) float32: unit vectors around which flakes turn, evenly distributed."""
    z = 2.0 * random_numbers(count, 9) - 1.0
    azimuth = 2.0 * math.pi * random_numbers(count, 10)
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z]).astype(np.float32)
