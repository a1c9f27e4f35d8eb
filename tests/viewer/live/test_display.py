"""Camera poses of browsers, and the rectangle of a photo in a window."""

import math

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at, quat_from_rotation
from snowsplat.viewer.live.pictures import PhotoRectangle, View, fit


def pose(fov: float = 1.0, width: int = 640, height: int = 480) -> View:
    eye = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    cam_from_world = look_at(eye, torch.zeros(3).double(), torch.tensor([0.0, -1.0, 0.0]).double())
    quat = quat_from_rotation(cam_from_world[:, :3].T)
    return View(0, tuple(quat.tolist()), tuple(eye.tolist()), fov, width, height)


def test_the_camera_of_a_browser():
    camera = pose().camera(320, 240)
    assert torch.allclose(camera.position, torch.tensor([1.0, 2.0, 3.0]).double())
    middle, depth = camera.project(torch.zeros(1, 3).double())
    assert middle[0].tolist() == pytest.approx([160, 120])
    assert float(depth) == pytest.approx(math.sqrt(14))
    assert 2 * math.atan(120 / camera.fy) == pytest.approx(1.0)


def test_fit_keeps_the_aspect_ratio_and_never_enlarges():
    assert fit(1920, 1080, 960) == (960, 540)
    assert fit(400, 300, 960) == (400, 300)
    assert fit(10_000, 3, 100) == (100, 1)


@pytest.mark.parametrize("window", [(640, 200), (200, 640), (300, 300)])
def test_a_photo_in_a_window_has_its_own_camera(window):
    """A point projects to the same position of the photo, for any rectangle."""
    identity = torch.eye(3, 4, dtype=torch.float64)
    camera = Camera(90, 60, 70.0, 72.0, 44.0, 31.0, identity)
    placed = PhotoRectangle.within(camera, *window)
    assert placed.width <= window[0]
    assert placed.height <= window[1]
    assert placed.width == window[0] or placed.height == window[1]
    assert placed.width / placed.height == pytest.approx(1.5, rel=0.02)
    whole = placed.camera(camera, *window)
    assert (whole.width, whole.height) == window
    points = torch.tensor([[0.1, 0.2, 1.0], [-0.5, 0.3, 2.0]]).double()
    own, _ = camera.project(points)
    there, _ = whole.project(points)
    scale = torch.tensor([placed.width / 90, placed.height / 60])
    corner = torch.tensor([placed.left, placed.top])
    assert torch.allclose(there, own * scale + corner)
