"""The decay of opacities and scales."""

import math

import pytest
import torch
from tests.gaussians import gaussians_in_box

from snowsplat.scene.gaussians import Gaussians
from snowsplat.training.parts.decay import INTERVAL, Decay
from snowsplat.training.settings.rates import DecayRates

from .stage import stage


def scene() -> Gaussians:
    generator = torch.Generator().manual_seed(5)
    bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    gaussians = gaussians_in_box(bounds, 7, generator)
    gaussians.opacity_logits = torch.linspace(-30.0, 30.0, 7)
    return gaussians


def test_an_epoch_reduces_opacities_and_scales_by_their_rates():
    views, epochs = 50, 3
    decay = Decay(DecayRates(opacity=0.04, scale=0.01))
    before, after = scene(), scene()
    for step in range(1, views * epochs + 1):
        decay.between(stage(after, step, views=views))
    torch.testing.assert_close(
        after.opacities[1:], math.exp(-0.04 * epochs) * before.opacities[1:], rtol=1e-4, atol=1e-7
    )
    torch.testing.assert_close(after.scales, math.exp(-0.01 * epochs) * before.scales)
    for name in ("means", "quats", "sh_dc", "sh_rest"):
        assert torch.equal(after.parameters()[name], before.parameters()[name])


@pytest.mark.parametrize(
    ("views", "factor"), [(200, 1.0), (50, 1.0), (40, 1.25), (20, 2.5), (10, 2.5)]
)
def test_the_rate_of_the_opacity_is_larger_with_few_views(views, factor):
    before, after = scene(), scene()
    Decay(DecayRates(opacity=0.04, scale=0.01)).between(stage(after, INTERVAL, views=views))
    epochs = INTERVAL / views
    expected = math.exp(-0.04 * factor * epochs) * before.opacities
    torch.testing.assert_close(after.opacities[1:], expected[1:], rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(after.scales, math.exp(-0.01 * epochs) * before.scales)


def test_logits_stay_finite():
    decay = Decay(DecayRates(opacity=5.0))
    gaussians = scene()
    for step in range(1000):
        decay.between(stage(gaussians, step, iterations=10_000))
    assert gaussians.opacity_logits.isfinite().all()
    assert float(gaussians.opacities.max()) < 1e-6


@pytest.mark.parametrize(
    ("step", "acts"), [(INTERVAL, True), (INTERVAL + 1, False), (500, True), (510, False)]
)
def test_it_acts_in_every_tenth_step_until_its_end(step, acts):
    gaussians = scene()
    decay = Decay(DecayRates(opacity=0.1, scale=0.1, until=0.5))
    decay.between(stage(gaussians, step, views=10))
    assert torch.equal(gaussians.log_scales, scene().log_scales) != acts
    assert torch.equal(gaussians.opacity_logits, scene().opacity_logits) != acts
