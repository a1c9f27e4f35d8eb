"""The smoothing spline: its known mathematical properties."""

import math

import pytest
import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import look_at
from snowsplat.trajectory.orbit import swing_path
from snowsplat.trajectory.spline import Spline


def test_interpolates_without_smoothing():
    random = torch.Generator().manual_seed(0)
    times = torch.rand(12, generator=random, dtype=torch.float64).sort().values
    values = torch.randn(12, 3, generator=random, dtype=torch.float64)
    torch.testing.assert_close(Spline(times, values)(times), values)


def test_follows_a_smooth_curve_between_its_samples():
    times = torch.linspace(0, 2 * math.pi, 40, dtype=torch.float64)
    between = torch.linspace(0.5, 5.5, 333, dtype=torch.float64)
    curve = Spline(times, times.sin()[:, None])(between)[:, 0]
    assert float((curve - between.sin()).abs().max()) < 1e-4


def test_minimises_its_penalty():
    """No curve nearby has a smaller penalty; the penalty is integrated numerically."""
    random = torch.Generator().manual_seed(1)
    times = torch.tensor([0.0, 0.5, 1.5, 2.0, 3.5, 4.0, 5.5, 6.0, 8.0], dtype=torch.float64)
    values = torch.randn(9, 1, generator=random, dtype=torch.float64)
    fine = torch.linspace(0, 8, 8001, dtype=torch.float64)

    def penalty(at_knots: torch.Tensor) -> float:
        curve = Spline(times, at_knots)(fine)  # the curve through these values that bends least
        bending = float((curve.diff(n=2, dim=0) / 0.001**2).square().sum() * 0.001)
        return float((values - at_knots).square().sum()) + 0.7 * bending

    best = Spline(times, values, 0.7)(times)
    least = penalty(best)
    for i in range(9):
        for change in (-0.02, 0.02):
            other = best.clone()
            other[i] += change
            assert penalty(other) > least


def test_long_waves_are_kept_and_short_waves_are_removed():
    times = torch.arange(400, dtype=torch.float64)
    smoothing = (8 / (2 * math.pi)) ** 4  # halves a wave with a period of 8 steps
    middle = times[100:300]
    for wavelength, kept in ((3, 0.03), (8, 0.5), (40, 0.998)):
        wave = (2 * math.pi * times / wavelength).sin()[:, None]
        left = Spline(times, wave, smoothing)(middle).square().mean()
        share = float((left / wave[100:300].square().mean()).sqrt())
        assert share == pytest.approx(kept, abs=0.05)


def test_invalid_times_are_rejected():
    for times in ([0.0], [0.0, 0.0], [1.0, 0.0]):
        with pytest.raises(ValueError, match="increasing times"):
            Spline(torch.tensor(times), torch.zeros(len(times), 2))


def test_a_closed_path_around_the_photo():
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    position = torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64)
    target = torch.tensor([0.5, 1.0, 4.0], dtype=torch.float64)
    photo = Camera(40, 30, 35.0, 35.0, 20.0, 15.0, look_at(position, target, up))
    frames = swing_path(photo, 5.0, 24)
    assert len(frames) == 24
    axis = photo.world_from_cam[:, 2]
    focus = position + 5 * axis
    offsets = torch.stack([frame.position for frame in frames]) - position
    torch.testing.assert_close(offsets.mean(0), torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(offsets @ axis, torch.zeros(24, dtype=torch.float64))
    steps = (offsets - offsets.roll(1, 0)).norm(dim=1)
    assert float(steps.max()) < 3 * float(steps.min())
    angles = []
    for frame in frames:
        pixel, _ = frame.project(focus[None])
        torch.testing.assert_close(pixel[0], torch.tensor([20.0, 15.0], dtype=torch.float64))
        angles.append(math.degrees(math.acos(float(frame.world_from_cam[:, 2] @ axis))))
        assert float(frame.cam_from_world[1, :3] @ photo.cam_from_world[1, :3]) > 0.99
    assert max(angles) < 4.01
    assert max(angles) > 3.9
