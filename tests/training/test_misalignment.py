"""`misalignment`: photos that are shifted against their renderings."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from torch import Tensor

from snowsplat.data.dataset import View
from snowsplat.data.photos.decode import ImageSource
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render
from snowsplat.training.parts.misalignment import misalignment, shift_between
from snowsplat.training.parts.pose_coordinates import after_motion

from .test_trainer import camera_at, true_scene


def waves(dx: float = 0.0, dy: float = 0.0) -> Tensor:
    """(40, 50, 3): a smooth image, shifted."""
    y, x = torch.meshgrid(torch.arange(40.0) - dy, torch.arange(50.0) - dx, indexing="ij")
    value = 0.5 + 0.2 * torch.sin(0.31 * x + 0.11 * y) + 0.2 * torch.cos(0.27 * y - 0.07 * x)
    return value[:, :, None].expand(-1, -1, 3)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, 0.0), (0.0, -0.3), (-0.5, 0.7)])
def test_the_shift_is_found(shift: tuple[float, float]) -> None:
    found = shift_between(waves(), waves(*shift))
    torch.testing.assert_close(found, torch.tensor(shift).double(), rtol=0.1, atol=0.02)


def test_the_exposure_does_not_matter() -> None:
    found = shift_between(waves(), 0.7 * waves(0.4, -0.2) + 0.1)
    torch.testing.assert_close(found, torch.tensor([0.4, -0.2]).double(), rtol=0.1, atol=0.02)


def test_masked_pixels_do_not_matter() -> None:
    photo, mask = waves(0.4, 0.0).clone(), torch.ones(40, 50, dtype=torch.bool)
    photo[10:30, 10:25], mask[10:30, 10:25] = 1.0, False
    assert abs(float(shift_between(waves(), photo, mask)[0]) - 0.4) < 0.04
    assert abs(float(shift_between(waves(), photo)[0]) - 0.4) > 0.1


def test_plain_images_have_no_shift() -> None:
    plain = torch.full((20, 20, 3), 0.4)
    assert float(shift_between(plain, plain).norm()) < 1e-9


def views_of(scene: Gaussians, folder: Path, count: int) -> list[View]:
    views = []
    for i in range(count):
        camera = camera_at(0.7 * i).scaled(72, 60)
        image = render(scene, camera).image.clamp(0, 1)
        path = folder / f"{i}.png"
        Image.fromarray((255 * image).round().to(torch.uint8).numpy().copy()).save(path)
        views.append(View(path.name, camera, ImageSource(path, 72, 60)))
    return views


def test_wrong_poses_are_found_and_exact_ones_are_not(tmp_path: Path) -> None:
    scene = true_scene()
    views = views_of(scene, tmp_path, 9)
    black = (0.0, 0.0, 0.0)
    assert misalignment(scene, views, black, 1000) is None
    turn = torch.tensor([0.0, 0.02, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)

    def turned(view: View) -> View:
        pose = after_motion(view.camera.cam_from_world, turn)
        return replace(view, camera=replace(view.camera, cam_from_world=pose))

    wrong = [turned(view) for view in views]
    pixels = misalignment(scene, wrong, black, 1000)
    assert pixels is not None
    assert 1.0 < pixels < 2.0  # 0.02 radians at a focal length of 78 pixels: 1.56 pixels
    assert misalignment(scene, wrong[:7], black, 1000) is None
    assert misalignment(scene, wrong, black, 499) is None  # the scene is not finished
    assert misalignment(scene, 40 * wrong, black, 700) is None  # 360 views
    assert misalignment(scene, 40 * wrong, black, 720) is not None
