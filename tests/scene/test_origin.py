"""The origin of a scene: chosen only where float32 is too coarse, and exact under edits."""

import numpy as np
import pytest
import torch

from snowsplat.scene import edit
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import Similarity
from snowsplat.scene.origin import HERE, add_origins, origin_of, stored_origin
from snowsplat.util.errors import UserError

POINTS = np.random.default_rng(0).normal(size=(1000, 3))
UTM = (500_000.0, 5_400_000.0, 300.0)


def scene(origin=HERE) -> Gaussians:
    means = torch.from_numpy(POINTS.astype(np.float32))
    n = len(means)
    shapes = (n, 3), (n, 4), (n,), (n, 1, 3), (n, 0, 3)
    return Gaussians(means, *(torch.full(shape, -3.0) for shape in shapes), origin=origin)


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_it_is_chosen_relative_to_the_extent(scale):
    points = scale * POINTS
    assert origin_of(points) == HERE
    assert origin_of(points + 100 * scale) == HERE
    far = origin_of(points + 1234.567 * scale)
    assert far == pytest.approx((1235 * scale,) * 3, rel=1e-3)
    assert origin_of(points + np.array(UTM) * scale) == pytest.approx(np.array(UTM) * scale)


def test_outliers_and_few_points_do_not_count():
    sky = 1e6 * POINTS[:200]
    assert origin_of(np.concatenate([POINTS + UTM, sky + UTM])) == UTM
    assert origin_of(np.concatenate([POINTS, sky])) == HERE
    assert origin_of(np.zeros((0, 3))) == HERE
    assert origin_of(np.full((5, 3), np.nan)) == HERE
    one = np.array([[1.0, 2.0, 3.0]])
    assert origin_of(one, 0.01) == HERE
    assert origin_of(one + UTM, 0.01) != HERE


def test_translation_is_exact_before_rounding():
    back = Similarity(1.0, torch.eye(3), -torch.tensor(UTM, dtype=torch.float64))
    moved = edit.transform_world(scene(UTM), back)
    assert moved.origin == HERE
    torch.testing.assert_close(moved.means, scene().means, rtol=0, atol=1e-6)
    there = Similarity(1.0, torch.eye(3), torch.tensor(UTM, dtype=torch.float64))
    assert edit.transform_world(scene(), there).origin == UTM
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = edit.transform_world(scene(UTM), Similarity(2.0, quarter, torch.zeros(3)))
    world = 2 * (POINTS.astype(np.float32) + np.array(UTM)) @ quarter.numpy().T
    np.testing.assert_allclose(turned.means.numpy() + np.array(turned.origin), world, atol=1e-5)


def test_crop_and_merge_are_in_the_world():
    box = torch.tensor([UTM, [x + 5 for x in UTM]], dtype=torch.float64)
    inside = (POINTS.astype(np.float32) >= 0).all(1).sum()
    assert len(edit.crop(scene(UTM), box)) == inside
    beside = edit.merge([scene(UTM), scene((UTM[0] + 2, *UTM[1:]))])
    assert beside.origin == UTM
    torch.testing.assert_close(beside.means[1000:, 0], scene().means[:, 0] + 2)


def test_a_camera_moves_with_the_scene():
    pose = torch.tensor([[0.0, 1, 0, 4], [-1, 0, 0, 5], [0, 0, 1, 6]], dtype=torch.float64)
    camera = Camera(9, 9, 5.0, 5.0, 4.5, 4.5, pose)
    moved = camera.seen_from((1.0, 2.0, 3.0))
    torch.testing.assert_close(moved.position, camera.position - torch.tensor([1.0, 2.0, 3.0]))


def test_stored_values_are_checked():
    assert stored_origin([1, 2.5, -3]) == (1.0, 2.5, -3.0)
    for value in (None, [1, 2], [1, 2, float("nan")], [1, 2, True], [1, 2, 1e300], "123"):
        assert stored_origin(value) is None
    assert add_origins(UTM, (1.0, 0.0, -300.0)) == (500_001.0, 5_400_000.0, 0.0)


@pytest.mark.parametrize(("scale", "size"), [(1e300, "large"), (1e-300, "small")])
def test_a_scale_that_float32_cannot_represent_is_refused(scale, size):
    with pytest.raises(UserError, match=size):
        edit.transform_world(scene(), Similarity(scale, torch.eye(3), torch.zeros(3)))
