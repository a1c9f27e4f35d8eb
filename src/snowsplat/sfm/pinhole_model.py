"""Converts the COLMAP model of the photos to a model of the undistorted images.

The new model has pinhole cameras and is in the frame of the scene (see `orient`).
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from snowsplat.data.lens.pinhole import Pinhole
from snowsplat.scene.geometry import Similarity

if TYPE_CHECKING:
    import pycolmap


def write_model(
    model: pycolmap.Reconstruction,
    pinholes: Mapping[int, Pinhole],
    scene_from_sfm: Similarity,
    sparse: Path,
) -> None:
    """Transform ``model`` in place and write it to ``sparse``/0; replaces an existing folder.

    Points keep their tracks and colours. Keypoints are moved to their undistorted positions.
    ``pinholes`` maps camera ids to the new cameras.
    """
    import pycolmap

    scale, rotation = scene_from_sfm.scale, scene_from_sfm.rotation.numpy()
    shift = scene_from_sfm.translation.numpy()[:, None]
    model.transform(pycolmap.Sim3d(np.concatenate([scale * rotation, shift], axis=1)))
    for image in model.images.values():
        _undistort_keypoints(image, model.cameras[image.camera_id], pinholes[image.camera_id])
    for number, pinhole in pinholes.items():
        camera = model.cameras[number]
        camera.model = pycolmap.CameraModelId.PINHOLE
        camera.width, camera.height = pinhole.width, pinhole.height
        camera.params = list(pinhole.params)
    # Write to a folder with a temporary name, so that ``sparse`` never contains a part of a model.
    new = sparse.with_name(f".{sparse.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    (new / "0").mkdir(parents=True)
    model.write(new / "0")
    model.export_PLY(new / "0" / "points3D.ply")
    shutil.rmtree(sparse, ignore_errors=True)
    new.rename(sparse)


def _undistort_keypoints(image: pycolmap.Image, camera: pycolmap.Camera, pinhole: Pinhole) -> None:
    points = image.points2D
    if not len(points):
        return
    fx, fy, cx, cy = pinhole.params
    pixels = camera.cam_from_img(np.array([point.xy for point in points])) * (fx, fy) + (cx, cy)
    for point, xy in zip(points, pixels, strict=True):
        # Near the border, the lens model may have no inverse. Programs that read the model need
        # finite numbers.
        point.xy = xy if np.isfinite(xy).all() else np.array([-1.0, -1.0])
