"""The formulas of docs/learn/density-control.md."""

import math

import pytest
import torch

from snowsplat import Gaussians
from snowsplat.ops import Splats2D, View, reference
from snowsplat.training.density.mcmc import McmcDensity
from snowsplat.training.settings.density import AdaptiveDensity


def one_gaussian() -> Gaussians:
    shapes = ((1, 3), (1, 3), (1, 4), (1,), (1, 1, 3), (1, 0, 3))
    scene = Gaussians(*(torch.zeros(shape, dtype=torch.float64) for shape in shapes))
    scene.log_scales.fill_(-2.0)
    return scene


def test_the_measure():
    """τ is the norm of the gradient in a screen that spans [-1, 1]."""
    pose = torch.eye(3, 4, dtype=torch.float64)
    pose[2, 3] = 3.0
    splats = reference.project(one_gaussian(), View(pose, 32, 24, 30.0, 30.0, 16.0, 12.0))
    packed = splats.packed.detach().requires_grad_()
    packed.grad = torch.zeros_like(packed)
    packed.grad[0, :2] = torch.tensor([0.3, -0.4])
    norm_sum, views = torch.zeros(1).double(), torch.zeros(1).double()
    reference.accumulate_screen_statistics(Splats2D(packed, splats.ids, 3), 32, 24, norm_sum, views)
    assert float(norm_sum) == pytest.approx(math.hypot(0.3 * 16, 0.4 * 12))
    assert float(views) == 1


def test_the_defaults_of_the_page():
    settings = AdaptiveDensity()
    assert (settings.grad_threshold, settings.densify_interval) == (2e-4, 100)
    assert (settings.percent_dense, settings.prune_opacity) == (0.01, 0.005)
    assert settings.opacity_reset_interval == 3000
    assert McmcDensity().max_gaussians >= 0
