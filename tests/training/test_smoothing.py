"""The smallest scales, by the sampling rates of the photos."""

import math
from dataclasses import replace

import torch
from tests.gaussians import gaussians_in_box

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.parts.limits import INTERVAL, VARIANCE, SmoothingFilter

from .stage import stage

POSE = torch.eye(3, 4, dtype=torch.float64)
NEAR = Camera(40, 30, 30.0, 30.0, 20.0, 15.0, POSE)
#: 8 units behind the other one, with 10 times the pixels.
FAR_POSE = POSE.clone()
FAR_POSE[2, 3] = 8.0
FAR = replace(NEAR.scaled(400, 300), cam_from_world=FAR_POSE)
# Seen by both, by the second one only (beside, behind the first), and by none (beside, behind).
MEANS = torch.tensor(
    [[0.0, 0.0, 2.0], [1.5, 0.0, 2.0], [0.0, 0.0, -1.0], [50.0, 0.0, 2.0], [0.0, 0.0, -9.0]]
)


def scene() -> Gaussians:
    bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    gaussians = gaussians_in_box(bounds, 5, torch.Generator().manual_seed(5))
    gaussians.means = MEANS.clone()
    gaussians.log_scales = torch.tensor([0.01, 1e-4, 0.5]).log().repeat(5, 1)
    gaussians.log_scales[1:] = math.log(1e-4)
    return gaussians


def apply(gaussians: Gaussians, step: int, cameras: list[Camera]) -> None:
    part, run = SmoothingFilter(), stage(gaussians, step, cameras=cameras)
    part.begin(run)
    part.between(run)


def test_all_scales_but_the_smallest_are_at_least_the_filter():
    before, after = scene(), scene()
    apply(after, INTERVAL, [NEAR, FAR])
    limits = math.sqrt(VARIANCE) / torch.tensor([30.0, 30.0, 300 / 7])
    torch.testing.assert_close(after.scales[0], torch.tensor([limits[0], 1e-4, 0.5]))
    for row in (1, 2):  # from needles to discs
        expected = torch.tensor([1e-4, limits[row], limits[row]])
        torch.testing.assert_close(after.scales[row].sort().values, expected)
    assert torch.equal(after.log_scales[3:], before.log_scales[3:])  # no photo shows them
    for name in ("means", "quats", "opacity_logits", "sh_dc", "sh_rest"):
        assert torch.equal(after.parameters()[name], before.parameters()[name])


def test_nothing_changes_between_the_steps_of_the_filter():
    gaussians = scene()
    apply(gaussians, INTERVAL + 1, [NEAR])
    assert torch.equal(gaussians.log_scales, scene().log_scales)
