"""Coverage: confirmed points, steps and directions of a model whose values are known."""

import numpy as np
import pytest
import torch

from snowsplat.scene.geometry import look_at
from snowsplat.sfm.report.coverage import measure_coverage

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


def sideways(positions: list[float]) -> torch.Tensor:
    """(N, 3, 4) poses on the x axis that look along z."""
    centres = [torch.tensor([x, 0.0, 0.0], dtype=torch.float64) for x in positions]
    ahead = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return torch.stack([look_at(centre, centre + ahead, UP) for centre in centres])


def wall(low: float, high: float, count: int = 400) -> torch.Tensor:
    """(count, 3) points in the plane z = 4 whose x is in a range."""
    x = torch.linspace(low, high, count)
    y = 0.5 * torch.sin(37.0 * x)
    return torch.stack([x, y, torch.full_like(x, 4.0)], 1)


@pytest.fixture
def measured(model_of, tmp_path):
    def measured(poses, points):
        model_of(poses, points).write(tmp_path)
        return measure_coverage(tmp_path)

    return measured


def test_a_walk_along_a_wall(measured):
    """A photo shows 6.4 units of the wall, at distance 4. The last photo shows mostly new parts."""
    coverage = measured(sideways([0.0, 1.0, 2.0, 3.0, 8.0]), wall(-5.0, 12.0))
    assert coverage.names == [f"{i:04d}.png" for i in range(5)]
    np.testing.assert_allclose(coverage.step, [0.25, 0.25, 0.25, 0.25, 1.25], rtol=1e-6)
    np.testing.assert_allclose(coverage.directions, 0.0, atol=1e-3)
    assert (coverage.confirmed[1:4] > 0.6).all()
    # Of the points that the last photo shares, those up to x = 5.2 are in the photo at x = 2, too.
    assert coverage.confirmed[4] == pytest.approx((5.2 - 4.8) / (6.2 - 4.8), abs=0.02)


def test_places(measured):
    """Brackets have one place. The small steps of a slow film add up."""
    brackets = sideways([0.0, 1e-3, 2e-3, 1.0, 1.002, 2.0])
    assert measured(brackets, wall(-3.0, 5.0)).place.tolist() == [0, 0, 0, 3, 3, 5]
    film = sideways([3e-3 * i for i in range(8)])
    assert measured(film, wall(-3.0, 5.0)).place.tolist() == [0, 0, 2, 2, 4, 4, 6, 6]


def test_a_photo_that_shares_nothing(measured):
    coverage = measured(sideways([0.0, 1.0, 2.0, 30.0]), wall(-3.0, 5.0))
    assert np.isinf(coverage.step[3])
    assert np.isnan(coverage.confirmed[3])


def test_directions(measured):
    centre = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    around = [
        look_at(centre + 4 * torch.tensor([np.sin(a), 0.0, -np.cos(a)]), centre, UP)
        for a in np.radians([-30.0, 0.0, 30.0])
    ]
    points = torch.randn(200, 3, generator=torch.Generator().manual_seed(0)) * 0.3 + centre
    coverage = measured(torch.stack(around), points)
    np.testing.assert_allclose(coverage.directions, [30.0, 0.0, 30.0], atol=1e-3)
    assert coverage.confirmed.min() == 1.0
