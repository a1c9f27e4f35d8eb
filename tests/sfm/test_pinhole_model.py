"""The undistorted model projects points to the undistorted positions, in the scene's frame."""

import numpy as np
import pycolmap
import pytest
import torch

from snowsplat.data.lens.models import lens_of
from snowsplat.data.lens.views import lens_views, pinhole_view
from snowsplat.scene.geometry import Similarity, look_at, rotation_from_quat
from snowsplat.sfm.pinhole_model import in_views, view_name, write_model

F64 = torch.float64
SCENE = Similarity(
    1.7,
    rotation_from_quat(torch.tensor([0.9, 0.1, -0.3, 0.2], dtype=F64)),
    torch.tensor([0.3, 0.2, -0.1], dtype=F64),
)


def opencv(strength: float) -> pycolmap.Camera:
    params = [260.0, 258.0, 164.0, 119.0, strength, 0.02, 0.001, -0.002]
    return pycolmap.Camera(model="OPENCV", width=320, height=240, params=params)


@pytest.fixture
def found(model_of) -> pycolmap.Reconstruction:
    """The result of SfM: two lenses, four photos."""
    up = torch.tensor([0, -1.0, 0], dtype=F64)
    centres = torch.tensor([[-1.0, 0, -4], [-0.3, 0.2, -4], [0.4, 0, -4], [1, -0.2, -4]]).double()
    poses = torch.stack([look_at(centre, 0 * up, up) for centre in centres])
    points = 0.8 * torch.randn(200, 3, generator=torch.Generator().manual_seed(1), dtype=F64)
    return model_of(poses, points, [opencv(-0.12), opencv(0.08)])


def written(model: pycolmap.Reconstruction, folder) -> pycolmap.Reconstruction:
    pinholes = {
        number: pinhole_view(
            lens_of(camera.model_name, camera.width, camera.height, tuple(camera.params))
        )
        for number, camera in model.cameras.items()
    }
    write_model(model, pinholes, SCENE, folder / "sparse")
    return pycolmap.Reconstruction(folder / "sparse" / "0")


def test_keypoints_without_an_undistorted_position_are_finite(found, tmp_path):
    camera = opencv(-0.9)  # the polynomial turns back inside the image
    corner = np.array([[1.0, 1.0]])
    assert not np.isfinite(camera.cam_from_img(corner)).all()
    found.cameras[1].params = camera.params
    image = found.images[1]
    image.points2D[0].xy = corner[0]
    after = written(found, tmp_path)
    positions = np.array([p.xy for p in after.images[1].points2D])
    assert np.isfinite(positions).all()
    assert tuple(positions[0]) == (-1.0, -1.0)


FISHEYE = lens_of("OPENCV_FISHEYE", 320, 240, (100.0, 100.0, 160.0, 120.0, 0.02, 0.0, 0.0, 0.0))


def test_photos_of_a_wide_lens_become_views(model_of):
    """Two lenses: only the photos of the second one, a fisheye lens of 183°, become views."""
    up = torch.tensor([0, -1.0, 0], dtype=F64)
    centres = torch.tensor([[-1.0, 0, -4], [-0.3, 0.2, -2], [0.4, 0, -4], [1, -0.2, -2]]).double()
    poses = torch.stack([look_at(centre, 0 * up, up) for centre in centres])
    points = 2 * torch.randn(300, 3, generator=torch.Generator().manual_seed(1), dtype=F64)
    wide = pycolmap.Camera(model=FISHEYE.model, width=320, height=240, params=FISHEYE.params)
    model = model_of(poses, points, [opencv(-0.12), wide])
    views = lens_views(FISHEYE)
    made = in_views(model, {2: views})
    assert len(made.images) == 2 + 2 * len(views)
    assert made.num_points3D() == model.num_points3D()
    errors = [
        np.linalg.norm(image.project_point(made.points3D[p.point3D_id].xyz) - p.xy)
        for image in made.images.values()
        for p in image.points2D
    ]
    assert len(errors) >= model.compute_num_observations()
    assert max(errors) < 1e-6
    centre = model.find_image_with_name("0001.png").projection_center()
    for view in views:
        image = made.find_image_with_name(view_name("0001.png", view))
        assert np.allclose(image.projection_center(), centre)


@pytest.mark.parametrize(
    "lens",
    [
        FISHEYE,
        lens_of("OPENCV", 320, 240, (260.0, 258.0, 164.0, 119.0, -0.12, 0.02, 0.001, -0.002)),
    ],
)
def test_directions_are_the_inverse_of_project(lens):
    pixels = np.random.default_rng(0).uniform(0, (320, 240), (500, 2))
    found = lens.directions(pixels)
    assert np.allclose(np.linalg.norm(found, axis=1), 1)
    assert np.abs(lens.project(found) - pixels).max() < 1e-6
