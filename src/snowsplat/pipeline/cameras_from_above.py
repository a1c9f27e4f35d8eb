"""`cameras_from_above`: a drawing of what a training run begins with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from snowsplat.data.points_ply import read_points
from snowsplat.pipeline.output.output_folder import OutputFolder
from snowsplat.scene.camera_json import read_cameras
from snowsplat.scene.geometry import Similarity, shortest_rotation
from snowsplat.scene.orientation import scene_up
from snowsplat.sfm.scene_map import PlacedPhoto, draw_scene


def cameras_from_above(output: Path | str) -> str:
    """An SVG drawing of the cameras and points of a training run, seen from above.

    It needs no points. Up is the up direction of the cameras, whatever that of the dataset is.

    ``output``: the output folder of a training run that has begun.

    Raises: UserError: its cameras or points are missing or damaged.
    """
    folder = OutputFolder(Path(output))
    names, cameras = read_cameras(folder.path / "cameras.json")
    up = scene_up(np.array([camera.cam_from_world[:, :3].numpy() for camera in cameras]))
    above = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)  # of the drawing
    turn = shortest_rotation(torch.from_numpy(up), above)
    level = Similarity(1.0, turn, torch.zeros(3, dtype=torch.float64))
    photos = [
        PlacedPhoto(
            name,
            None,
            camera.transformed(level).cam_from_world.numpy(),
            camera.width / 2 / camera.fx,
            camera.height / 2 / camera.fy,
        )
        for name, camera in zip(names, cameras, strict=True)
    ]
    points = folder.path / "input.ply"
    if not points.is_file():
        return draw_scene(photos, np.empty((0, 3)), np.empty((0, 3), np.uint8))[0].svg
    xyz, rgb = read_points(points)
    return draw_scene(photos, xyz.astype(np.float64) @ turn.numpy().T, rgb)[0].svg
