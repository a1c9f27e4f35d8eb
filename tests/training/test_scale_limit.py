"""The limits of scales: by the distance to the cameras, and by the sampling rates of the photos."""

import math
from dataclasses import replace

import pytest
import torch
from tests.gaussians import gaussians_in_box

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.training.parts.limits import INTERVAL, VARIANCE, ScaleLimit, SmoothingFilter

from .stage import stage


def scene(means: list[list[float]], scales: list[float]) -> Gaussians:
    bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    gaussians = gaussians_in_box(bounds, len(means), torch.Generator().manual_seed(5))
    gaussians.means = torch.tensor(means)
    gaussians.log_scales = torch.tensor(scales).log().repeat(len(means), 1)
    return gaussians


def apply(
    part: ScaleLimit | SmoothingFilter,
    before: Gaussians,
    cameras: list[Camera],
    step: int = INTERVAL,
) -> Gaussians:
    """The scene after a step; only scales change, and those only in the steps of the limit."""
    after = before.clone()
    run = stage(after, step, cameras=cameras)
    part.begin(run)
    part.between(run)
    for name in ("means", "quats", "opacity_logits", "sh_dc", "sh_rest"):
        assert torch.equal(after.parameters()[name], before.parameters()[name])
    return after


# By the distance


def camera(x: float) -> Camera:
    up, target = torch.tensor([0.0, -1.0, 0.0]), torch.tensor([x, 0.0, 9.0])
    pose = look_at(torch.tensor([x, 0.0, 0.0]).double(), target.double(), up.double())
    return Camera(40, 30, 30.0, 30.0, 20.0, 15.0, pose)


CAMERAS = [camera(0.0), camera(100.0)]
#: At the distances 2, 8, 5 and 0 from the nearest camera.
PLACES = [[2.0, 0.0, 0.0], [0.0, 0.0, 8.0], [103.0, 4.0, 0.0], [0.0, 0.0, 0.0]]
SCALES = [0.5, 1.5, 3.0]


def test_scales_are_at_most_the_share_of_the_distance_to_the_nearest_camera():
    before = scene(PLACES, SCALES)
    after = apply(ScaleLimit(0.5), before, CAMERAS)
    limits = torch.tensor([1.0, 4.0, 2.5])
    torch.testing.assert_close(after.scales[:3], torch.minimum(before.scales[:3], limits[:, None]))
    assert after.log_scales.isfinite().all()
    assert float(after.scales[3].max()) < 1e-30


def test_many_cameras_are_sampled():
    many = [camera(0.01 * i) for i in range(1000)]
    places = [*PLACES[:2], [0.01, 0.0, 0.0], [0.16, 0.0, 0.0]]
    scales = apply(ScaleLimit(0.5), scene(places, SCALES), many).scales
    # At the second and at the 17th camera: every 16th is used.
    assert math.isclose(float(scales[2].max()), 0.005, rel_tol=1e-5)
    assert float(scales[3].max()) < 1e-30
    assert math.isclose(float(scales[1].max()), 3.0, rel_tol=1e-6)  # below the limit, 4


# By the sampling rates

POSE = torch.eye(3, 4, dtype=torch.float64)
NEAR = Camera(40, 30, 30.0, 30.0, 20.0, 15.0, POSE)
#: 8 units behind the other one, with 10 times the pixels.
FAR_POSE = POSE.clone()
FAR_POSE[2, 3] = 8.0
FAR = replace(NEAR.scaled(400, 300), cam_from_world=FAR_POSE)
#: Seen by both, by the second one only (beside, behind the first), and by none (beside, behind).
MEANS = [[0.0, 0.0, 2.0], [1.5, 0.0, 2.0], [0.0, 0.0, -1.0], [50.0, 0.0, 2.0], [0.0, 0.0, -9.0]]


def test_all_scales_but_the_smallest_are_at_least_the_filter():
    before = scene(MEANS, [1e-4] * 3)
    before.log_scales[0] = torch.tensor([0.01, 1e-4, 0.5]).log()
    after = apply(SmoothingFilter(), before, [NEAR, FAR])
    limits = math.sqrt(VARIANCE) / torch.tensor([30.0, 30.0, 300 / 7])
    torch.testing.assert_close(after.scales[0], torch.tensor([limits[0], 1e-4, 0.5]))
    for row in (1, 2):  # from needles to discs
        expected = torch.tensor([1e-4, limits[row], limits[row]])
        torch.testing.assert_close(after.scales[row].sort().values, expected)
    assert torch.equal(after.log_scales[3:], before.log_scales[3:])  # no photo shows them


@pytest.mark.parametrize("part", [ScaleLimit(0.5), SmoothingFilter()])
def test_nothing_changes_between_the_steps(part):
    before = scene([*PLACES, *MEANS], SCALES)
    after = apply(part, before, [NEAR, *CAMERAS], INTERVAL + 1)
    assert torch.equal(after.log_scales, before.log_scales)
