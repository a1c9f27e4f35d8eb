"""The limit of Gaussians near the cameras."""

import pytest
import torch
from tests.gaussians import gaussians_in_box
from torch import Tensor

from snowsplat.data import load_dataset
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.parts.limits import (
    INTERVAL,
    NearLimit,
    beside,
    nearest_depth,
    unseen_cameras,
)
from snowsplat.training.settings.recipes import recipe

from .stage import stage


def camera(x: float, along: float = 1.0) -> Camera:
    """At (x, 0, 0), looking along z or against it, with a field of view of 90° each way."""
    position = torch.tensor([x, 0.0, 0.0]).double()
    forward, up = (
        torch.tensor([0.0, 0.0, 9.0 * along]).double(),
        torch.tensor([0.0, -1.0, 0.0]).double(),
    )
    return Camera(40, 40, 20.0, 20.0, 20.0, 20.0, look_at(position, position + forward, up))


def wall(depth: float = 10.0) -> Tensor:
    """(400, 3) points on the plane z = depth; all cameras between x = −3 and 3 see most of them."""
    grid = torch.linspace(-8.0, 8.0, 20)
    x, y = torch.meshgrid(grid, grid, indexing="ij")
    return torch.stack([x, y, torch.full_like(x, depth)], dim=2).reshape(-1, 3)


def removed(
    cameras: list[Camera],
    points: Tensor | None,
    means: list[list[float]],
) -> list[bool]:
    """Which Gaussians at ``means`` a limit of 0.5 removes."""
    bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    gaussians = gaussians_in_box(bounds, len(means), torch.Generator().manual_seed(5))
    gaussians.means = torch.tensor(means)
    before = gaussians.clone()
    limit, run = NearLimit(0.5), stage(gaussians, INTERVAL, cameras=cameras, points=points)
    limit.begin(run)
    limit.between(run)
    for name, tensor in gaussians.parameters().items():
        if name != "opacity_logits":
            assert torch.equal(tensor, before.parameters()[name])
    changed = gaussians.opacity_logits != before.opacity_logits
    assert float(gaussians.opacities[changed].sum()) < len(means) / 255
    return changed.tolist()


def test_gaussians_in_front_of_the_points_are_removed():
    near = [[0.0, 0.0, 4.9], [0.0, 0.0, 0.1], [4.8, -4.8, 4.9]]
    kept = [[0.0, 0.0, 5.1], [0.0, 0.0, -5.1], [9.0, 0.0, 4.9], [0.0, 0.0, 10.0]]
    assert removed([camera(0.0)], wall(), near + kept) == [True] * 3 + [False] * 4


def test_also_in_views_that_nobody_photographed():
    """A Gaussian between the fields of view of two cameras, and one beside the first of them."""
    first, second = camera(-3.0), camera(3.0)
    beside, outside = [-8.5, 0.0, 4.5], [-9.3, 0.0, 4.5]
    assert removed([first], wall(), [beside, outside]) == [False] * 2
    assert removed([first, second], wall(), [beside, outside]) == [True, False]
    positions = sorted(float(c.position[0]) for c in unseen_cameras([first, second], wall()))
    assert positions == pytest.approx([-4.5, 0.0, 0.0, 4.5], abs=1e-6)


@pytest.mark.parametrize(("along", "share"), [(1.0, -0.5), (1.0, 0.25), (-1.0, -0.5)])
def test_an_unseen_camera_is_on_the_line_through_two_cameras(along, share):
    """Also if they look in opposite directions."""
    first, second = camera(-3.0), camera(3.0, along)
    moved = beside(first, second, share)
    expected = (1.0 + share) * first.position - share * second.position
    assert torch.allclose(moved.position, expected, atol=1e-9)
    rotation = moved.cam_from_world[:, :3]
    assert torch.allclose(rotation @ rotation.T, torch.eye(3).double(), atol=1e-9)
    assert torch.det(rotation) == pytest.approx(1.0)
    assert (moved.width, moved.fx, moved.cx) == (first.width, first.fx, first.cx)


def test_near_a_camera_remains_what_two_photos_show():
    """The other cameras look away from the points, so they have no limits themselves."""
    front = [camera(0.0), camera(0.2), camera(0.4)]
    back = [camera(x, along=-1.0) for x in (0.0, 0.2)]
    behind = [[0.0, 0.0, -1.0], [0.0, 0.0, -4.9], [0.0, 0.0, -5.2]]
    for others, expected in (([], True), (back[:1], True), (back, False)):
        found = removed(front + others, wall(), behind)
        assert found == [expected, expected, False]


def test_a_few_wrong_points_do_not_matter():
    wrong = torch.tensor([[0.0, 0.0, 0.5]] * 4)
    assert nearest_depth(camera(0.0), torch.cat([wall(), wrong])) == pytest.approx(10.0)
    assert removed([camera(0.0)], torch.cat([wall(), wrong]), [[0.0, 0.0, 4.0]]) == [True]


def test_views_with_few_points_have_no_limit():
    assert nearest_depth(camera(0.0), wall()[::10]) == 0.0
    assert removed([camera(0.0)], wall()[::10], [[0.0, 0.0, 4.0]]) == [False]


def test_nothing_is_removed_without_points_and_between_the_steps_of_the_limit():
    assert removed([camera(0.0)], None, [[0.0, 0.0, 4.0]]) == [False]
    gaussians = gaussians_in_box(
        torch.tensor([[-1.0, -1.0, 1.0], [1.0, 1.0, 2.0]]), 9, torch.Generator().manual_seed(5)
    )
    before = gaussians.clone()
    run = stage(gaussians, INTERVAL + 1, cameras=[camera(0.0)], points=wall())
    limit = NearLimit(0.5)
    limit.begin(run)
    limit.between(run)
    assert torch.equal(gaussians.opacity_logits, before.opacity_logits)


def test_a_training_run_without_a_floater(tmp_path):
    """An opaque Gaussian in front of a camera is removed by density control."""
    dataset = load_dataset(write_toy_dataset(tmp_path, "colmap-bin", 8, 48, 36, n_points=400))
    trainer = Trainer(dataset, recipe("default", iterations=300, init="points"))
    trainer.run(until=INTERVAL)
    viewer = dataset.train[0].camera.world_from_cam
    floater = (viewer[:, 3] + 0.1 * viewer[:, 2]).to(torch.float32)
    trainer.gaussians.means[0] = floater
    trainer.gaussians.opacity_logits[0] = 6.0
    trainer.run(until=INTERVAL + 1)
    distances = (trainer.gaussians.means - floater).norm(dim=1)
    assert float(distances.min()) > 0.05
