"""Cameras where nobody took a photo, near the cameras of the photos."""

from __future__ import annotations

from dataclasses import replace

import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import invert_rigid


def beside(first: Camera, second: Camera, share: float) -> Camera:
    """The first camera, moved and rotated away from the second one by a share of their difference.

    With a negative share, it moves towards the second one; −1 is the pose of the second camera.

    The rotation is the nearest one to (1 + share) R₁ − share R₂.
    """
    a, b = (camera.world_from_cam.to(torch.float64) for camera in (first, second))
    moved = (1.0 + share) * a - share * b
    u, _, vt = torch.linalg.svd(moved[:, :3])
    if torch.det(u @ vt) < 0.0:  # the two directions are almost opposite
        vt[2] = -vt[2]
    world_from_cam = torch.cat([u @ vt, moved[:, 3:]], dim=1)
    return replace(first, cam_from_world=invert_rigid(world_from_cam))
