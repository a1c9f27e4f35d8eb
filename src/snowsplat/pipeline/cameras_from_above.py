"""Drawings from above of cameras whose frame may have any up direction: `draw_level`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from snowsplat.data.points_ply import read_points
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.scene.camera_json import read_cameras
from snowsplat.scene.geometry import shortest_rotation
from snowsplat.scene.orientation import scene_up
from snowsplat.sfm.report.scene_map import PlacedPhoto, draw_scene


def cameras_from_above(training: TrainingFolder) -> str:
    """An SVG drawing of the cameras and points of a training run, seen from above.

    It needs no points. Up is the up direction of the cameras, whatever that of the dataset is.

    Raises: UserError: the training has not begun; or its cameras or points are missing or damaged.
    """
    names, cameras = read_cameras(training.cameras)
    photos = [
        PlacedPhoto(
            name,
            None,
            camera.cam_from_world.numpy(),
            camera.width / 2 / camera.fx,
            camera.height / 2 / camera.fy,
        )
        for name, camera in zip(names, cameras, strict=True)
    ]
    if not training.points.is_file():
        return draw_level(photos, np.empty((0, 3)))
    return draw_level(photos, *read_points(training.points))


def draw_level(
    photos: Sequence[PlacedPhoto], xyz: np.ndarray, rgb: np.ndarray | None = None
) -> str:
    """An SVG drawing from above, where up is the up direction of the cameras.

    Args:
        photos: at least one; their frame may be any.
        xyz: (P, 3) points.
        rgb: (P, 3) uint8, their colours; None: grey.
    """
    up = scene_up(np.array([photo.cam_from_world[:, :3] for photo in photos]))
    above = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)  # of the drawing
    back = shortest_rotation(torch.from_numpy(up), above).numpy().T
    level = []
    for photo in photos:
        pose = photo.cam_from_world
        turned = np.column_stack([pose[:, :3] @ back, pose[:, 3]])
        level.append(replace(photo, cam_from_world=turned))
    colours = np.full(xyz.shape, 128, np.uint8) if rgb is None else rgb
    return draw_scene(level, xyz.astype(np.float64) @ back, colours)[0].svg
