"""The limit of scales by the distance to the cameras."""

import math

import torch
from tests.gaussians import gaussians_in_box

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.training.parts.limits import INTERVAL, ScaleLimit

from .stage import stage


def camera(x: float) -> Camera:
    up, target = torch.tensor([0.0, -1.0, 0.0]), torch.tensor([x, 0.0, 9.0])
    pose = look_at(torch.tensor([x, 0.0, 0.0]).double(), target.double(), up.double())
    return Camera(40, 30, 30.0, 30.0, 20.0, 15.0, pose)


CAMERAS = [camera(0.0), camera(100.0)]


def scene() -> Gaussians:
    """Means at the distances 2, 8, 5 and 0 from the nearest camera; scales 0.5, 1.5 and 3."""
    bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    gaussians = gaussians_in_box(bounds, 4, torch.Generator().manual_seed(5))
    gaussians.means = torch.tensor(
        [[2.0, 0.0, 0.0], [0.0, 0.0, 8.0], [103.0, 4.0, 0.0], [0.0, 0.0, 0.0]]
    )
    gaussians.log_scales = torch.tensor([0.5, 1.5, 3.0]).log().repeat(4, 1)
    return gaussians


def apply(gaussians: Gaussians, step: int, cameras: list[Camera]) -> None:
    part, run = ScaleLimit(0.5), stage(gaussians, step, cameras=cameras)
    part.begin(run)
    part.between(run)


def test_scales_are_at_most_the_share_of_the_distance_to_the_nearest_camera():
    before, after = scene(), scene()
    apply(after, INTERVAL, CAMERAS)
    limits = torch.tensor([1.0, 4.0, 2.5])
    torch.testing.assert_close(after.scales[:3], torch.minimum(before.scales[:3], limits[:, None]))
    assert after.log_scales.isfinite().all()
    assert float(after.scales[3].max()) < 1e-30
    for name in ("means", "quats", "opacity_logits", "sh_dc", "sh_rest"):
        assert torch.equal(after.parameters()[name], before.parameters()[name])


def test_nothing_changes_between_the_steps_of_the_limit():
    before, after = scene(), scene()
    apply(after, INTERVAL + 1, CAMERAS)
    assert torch.equal(after.log_scales, before.log_scales)


def test_many_cameras_are_sampled():
    many = [camera(0.01 * i) for i in range(1000)]
    gaussians = scene()
    gaussians.means[2:] = torch.tensor([[0.01, 0.0, 0.0], [0.16, 0.0, 0.0]])
    apply(gaussians, INTERVAL, many)
    # At the second and at the 17th camera: every 16th is used.
    assert math.isclose(float(gaussians.scales[2].max()), 0.005, rel_tol=1e-5)
    assert float(gaussians.scales[3].max()) < 1e-30
    assert math.isclose(float(gaussians.scales[1].max()), 3.0, rel_tol=1e-6)  # below the limit, 4
