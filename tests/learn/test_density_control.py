"""The formulas of docs/learn/density-control.md."""

import math

import pytest
import torch

from snowsplat import Gaussians
from snowsplat.ops import Splats2D, View, reference
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.training.density.adaptive import RESET_OPACITY, SPLIT_SHRINK, AdaptiveDensityControl
from snowsplat.training.density.mcmc import McmcDensity
from snowsplat.training.settings.density import AdaptiveDensity
from snowsplat.training.settings.rates import LearningRates
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.step.optim import Adam


def gaussians(log_scales: list[float], opacities: list[float]) -> Gaussians:
    n = len(log_scales)
    logits = [math.log(o / (1 - o)) for o in opacities]
    return Gaussians(
        means=torch.arange(3.0 * n).reshape(n, 3),
        log_scales=torch.tensor(log_scales)[:, None] + torch.tensor([[0.0, -0.5, -1.0]]),
        quats=torch.tensor([[0.9, 0.1, 0.3, 0.2]]).repeat(n, 1),
        opacity_logits=torch.tensor(logits),
        sh_dc=torch.zeros(n, 1, 3),
        sh_rest=torch.zeros(n, 0, 3),
    )


def refined(scene: Gaussians, grads: list[float], seed: int = 0) -> Gaussians:
    """The scene after one densification at step 600, with these mean gradients."""
    schedule = Schedule(30_000)
    optimizer = Adam(scene, LearningRates(), schedule=schedule, extent=1.0)
    control = AdaptiveDensityControl.begin(
        AdaptiveDensity(prune_screen_size=0.0),
        len(scene),
        schedule=schedule,
        extent=1.0,
        random_init=False,
        generator=torch.Generator().manual_seed(seed),
    )
    control.grad_sum[:] = torch.tensor(grads) * 3
    control.views[:] = 3
    return control.after_step(600, scene, optimizer)


def test_the_measure():
    """τ is the norm of the gradient in a screen that spans [-1, 1]."""
    pose = torch.eye(3, 4, dtype=torch.float64)
    pose[2, 3] = 3.0
    scene = gaussians([-2.0], [0.5]).map(torch.Tensor.double)
    splats = reference.project(scene, View(pose, 32, 24, 30.0, 30.0, 16.0, 12.0))
    packed = splats.packed.detach().requires_grad_()
    packed.grad = torch.zeros_like(packed)
    packed.grad[0, :2] = torch.tensor([0.3, -0.4])
    norm_sum, views = torch.zeros(1).double(), torch.zeros(1).double()
    reference.accumulate_screen_statistics(Splats2D(packed, splats.ids, 3), 32, 24, norm_sum, views)
    assert float(norm_sum) == pytest.approx(math.hypot(0.3 * 16, 0.4 * 12))
    assert float(views) == 1


def test_clone_split_prune():
    small, large = math.log(0.005), math.log(0.1)
    scene = gaussians([small, large, small, small], [0.5, 0.5, 0.5, 0.004])
    after = refined(scene, [3e-4, 3e-4, 1e-4, 3e-4])
    # The first is cloned, the second is split, the third stays, the fourth is pruned.
    assert len(after) == 2 + 2 + 1
    largest = after.scales.amax(dim=1)
    assert sorted(largest.tolist()) == pytest.approx([0.005] * 3 + [0.1 / SPLIT_SHRINK] * 2)
    assert SPLIT_SHRINK == 1.6
    assert pytest.approx(0.24, abs=5e-3) == SPLIT_SHRINK**-3


def test_the_children_have_the_distribution_of_the_parent():
    """μ + R S ε has the covariance R S Sᵀ Rᵀ, and a mean distance of 1.25 σ (exercise 2)."""
    n = 4000
    scene = gaussians([math.log(0.1)] * n, [0.5] * n)
    scene.means[:] = 0
    R = rotation_from_quat(scene.quats[0])
    S = torch.diag(scene.scales[0])
    after = refined(scene, [3e-4] * n)
    assert len(after) == 2 * n
    sigma = R @ S @ S.T @ R.T
    assert torch.allclose(torch.cov(after.means.T), sigma, atol=0.06 * float(sigma.max()))
    planar = (torch.randn(100_000, 2, generator=torch.Generator().manual_seed(0))).norm(dim=1)
    assert float(planar.mean()) == pytest.approx(math.sqrt(math.pi / 2), rel=0.01)


def test_the_opacity_reset():
    scene = gaussians([-5.0, -5.0], [0.9, 0.006])
    schedule = Schedule(30_000)
    optimizer = Adam(scene, LearningRates(), schedule=schedule, extent=1.0)
    optimizer.exp_avg["opacity_logits"][:] = 1.0
    control = AdaptiveDensityControl.begin(
        AdaptiveDensity(),
        2,
        schedule=schedule,
        extent=1.0,
        random_init=False,
        generator=torch.Generator(),
    )
    after = control.after_step(3000, scene, optimizer)
    assert after.opacities.sort().values.tolist() == pytest.approx([0.006, RESET_OPACITY])
    assert RESET_OPACITY == 0.01
    assert not optimizer.exp_avg["opacity_logits"].any()


def test_the_defaults_of_the_page():
    settings = AdaptiveDensity()
    assert (settings.grad_threshold, settings.densify_interval) == (2e-4, 100)
    assert (settings.percent_dense, settings.prune_opacity) == (0.01, 0.005)
    assert settings.opacity_reset_interval == 3000
    assert McmcDensity().max_gaussians >= 0


def test_the_opacity_of_mcmc():
    for o in (0.1, 0.8):
        for n in (2, 5):
            shared = 1 - (1 - o) ** (1 / n)
            assert 1 - (1 - shared) ** n == pytest.approx(o)
    # Exercise 1.
    assert pytest.approx(0.96) == 1 - 0.2**2
    assert 1 - math.sqrt(0.2) == pytest.approx(0.553, abs=5e-4)
