"""Sign changes of axes: a camera with the same change sees the same image."""

import itertools

import pytest
import torch

from snowsplat.formats import GaussianArrays, packing
from snowsplat.formats.packing import UP_BACK
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.scene.render import render


def flipped(scene: Gaussians, signs: tuple[int, int, int]) -> Gaussians:
    return packing.flip_axes(GaussianArrays.from_gaussians(scene), signs).to_gaussians()


def test_a_camera_converted_to_y_up_z_back_sees_the_same_image(make_scene):
    scene = make_scene(300, 3)
    pose = look_at(torch.tensor([1.0, -2.0, -4.0]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    turned = pose.clone()
    turned[:, 1:3] *= -1
    images = [
        render(g, Camera(160, 120, 150.0, 150.0, 80.0, 60.0, p)).image
        for g, p in ((scene, pose), (flipped(scene, UP_BACK), turned))
    ]
    assert images[0].amax() > 0.5
    torch.testing.assert_close(images[1], images[0], rtol=0, atol=1e-4)


@pytest.mark.parametrize("signs", list(itertools.product((1, -1), repeat=3)))
def test_a_reflected_scene_has_a_mirrored_image(make_scene, signs):
    scene = make_scene(300, 3)
    x, y, z = signs
    # If z is mirrored, the camera looks from behind; its x axis then points the other way.
    pose = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5]])
    behind = torch.tensor([[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 5]])
    first, second = (
        render(g, Camera(160, 120, 150.0, 150.0, 80.0, 60.0, p)).image
        for g, p in ((scene, pose), (flipped(scene, signs), pose if z > 0 else behind))
    )
    if x * z < 0:
        first = first.flip(1)
    if y < 0:
        first = first.flip(0)
    torch.testing.assert_close(second, first, rtol=0, atol=1e-3)


def test_two_equal_sign_changes_cancel(make_scene):
    scene = make_scene(9, 2)
    again = flipped(flipped(scene, UP_BACK), UP_BACK)
    for name, tensor in scene.parameters().items():
        assert torch.equal(again.parameters()[name], tensor)
