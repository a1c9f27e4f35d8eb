"""A small closed path around one camera, which shows the depth of a scene from one photo."""

from __future__ import annotations

import dataclasses
import math

import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import compose_rigid, look_at

# Largest angle between the optical axes of a frame and of the photo.
_SWING = math.radians(4)


def swing_path(camera: Camera, distance: float, frames: int) -> list[Camera]:
    """``frames`` cameras on an ellipse around the position of ``camera``, in its image plane.

    All look at the point at ``distance`` (world units) on its optical axis, so that this point does
    not move in the image. The ellipse is half as high as it is wide.
    """
    angles = 2 * math.pi * torch.arange(frames, dtype=torch.float64) / frames
    radius = distance * math.tan(_SWING)
    positions = torch.stack(
        [radius * angles.cos(), 0.5 * radius * angles.sin(), torch.zeros_like(angles)], dim=1
    )
    # In the frame of the camera; its y axis points down.
    target = torch.tensor([0.0, 0.0, distance], dtype=torch.float64).expand_as(positions)
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    poses = compose_rigid(look_at(positions, target, up), camera.cam_from_world.double())
    return [dataclasses.replace(camera, cam_from_world=pose) for pose in poses]
