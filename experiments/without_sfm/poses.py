"""Camera poses as small motions that gradient descent can optimise."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import compose_rigid


class Poses:
    """The poses of N photos with the same intrinsics, each with a motion that is optimised.

    The pose of photo i is exp(ξᵢ) Tᵢ. Tᵢ (``base``) is constant during an optimisation; ξᵢ (6,)
    is a rotation vector in radians and a translation in world units, and starts at 0.
    """

    def __init__(self, camera: Camera, count: int) -> None:
        self.camera = camera
        identity = torch.eye(4, dtype=torch.float64)[:3]
        self.base = identity.repeat(count, 1, 1)  # (N, 3, 4), cam_from_world
        self.motion = torch.zeros(count, 6, dtype=torch.float64, requires_grad=True)

    def part(self, count: int) -> Poses:
        """The poses of the first photos; ``base`` shares its memory."""
        part = Poses(self.camera, count)
        part.base = self.base[:count]
        return part

    def pose(self, i: int) -> Tensor:
        """(3, 4), differentiable with respect to ``motion``."""
        return compose_rigid(exponential(self.motion[i]), self.base[i])

    def camera_of(self, i: int, factor: int) -> Camera:
        """The camera of photo i for an image that is reduced by a factor."""
        camera = self.camera if factor == 1 else self.camera.downscaled(factor)
        return replace(camera, cam_from_world=self.pose(i))

    @torch.no_grad()
    def fold(self) -> None:
        """Move the motions into ``base``."""
        for i in range(len(self.base)):
            self.base[i] = self.pose(i)
        self.motion.zero_()

    @torch.no_grad()
    def scale(self, factor: float) -> None:
        """Multiply all positions: the unit of length is arbitrary without known distances."""
        self.base[:, :, 3] *= factor


def exponential(motion: Tensor) -> Tensor:
    """(3, 4): the rotation exp([ω]×) and the translation of (ω, t) (6,)."""
    x, y, z = motion[:3].unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    return torch.cat([torch.linalg.matrix_exp(cross), motion[3:, None]], dim=1)
