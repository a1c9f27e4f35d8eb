"""COLMAP models of known cameras and points, in the form that SfM returns."""

from collections.abc import Callable, Sequence

import numpy as np
import pycolmap
import pytest
import torch


def make_model(
    poses: torch.Tensor,
    points: torch.Tensor,
    cameras: Sequence[pycolmap.Camera] | None = None,
    names: Sequence[str] | None = None,
) -> pycolmap.Reconstruction:
    """A model in which every camera sees every point that is inside its image.

    ``poses`` (N, 3, 4) are cam_from_world, ``points`` (P, 3). Photo i uses camera i modulo the
    number of cameras.
    """
    if cameras is None:
        simple = pycolmap.CameraModelId.SIMPLE_PINHOLE
        cameras = [pycolmap.Camera.create_from_model_id(1, simple, 100.0, 160, 120)]
    model = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras, 1):
        camera.camera_id = number
        model.add_camera_with_trivial_rig(camera)
    world, tracks = points.double().numpy(), [pycolmap.Track() for _ in points]
    for i, pose in enumerate(poses.double().numpy()):
        camera = cameras[i % len(cameras)]
        in_camera = world @ pose[:, :3].T + pose[:, 3]
        pixels = camera.img_from_cam(in_camera)
        with np.errstate(invalid="ignore"):
            inside = (pixels > 0) & (pixels < [camera.width, camera.height])
        seen = np.flatnonzero(inside.all(axis=1) & (in_camera[:, 2] > 0))
        image = pycolmap.Image(
            names[i] if names else f"{i:04d}.png", pixels[seen], camera.camera_id, i + 1
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for keypoint, point in enumerate(seen):
            tracks[point].add_element(i + 1, keypoint)
    for xyz, track in zip(world, tracks, strict=True):
        if track.length() >= 2:
            number = model.add_point3D(xyz, track, np.array([200, 100, 50], np.uint8))
            assert model.exists_point3D(number)
    return model


@pytest.fixture(scope="session")
def model_of() -> Callable[..., pycolmap.Reconstruction]:
    """`make_model`."""
    return make_model
