"""The update of Adam, and the bookkeeping of its moments."""

import math

import pytest
import torch

from snowsplat import ops
from snowsplat.ops import reference
from snowsplat.ops.splats import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import project
from snowsplat.training.settings.rates import LearningRates
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.step.optim import Adam
from snowsplat.training.step.view_gradient import ViewGradient

from ..gaussians import normal_gaussians


def some_gaussians(n: int = 5, degree: int = 1) -> Gaussians:
    return normal_gaussians(n, degree, seed=n)


def one_step(adam: Adam, gaussians: Gaussians, step: int, regulariser: float) -> None:
    """A step whose view sees no Gaussian: the gradient is that of a regulariser alone."""
    gaussians.opacity_logits.grad = torch.full_like(gaussians.opacity_logits, regulariser)
    splats = Splats2D(torch.zeros(0, 16), torch.zeros(0, dtype=torch.int32), 3)
    splats.packed.grad = torch.zeros(0, 16)
    camera = Camera(10, 10, 10.0, 10.0, 5.0, 5.0, torch.eye(3, 4).double())
    adam.step(gaussians, [ViewGradient(splats, camera, 0)], step)


def test_two_steps_of_kingma_and_ba():
    """With a gradient g, then 0: Δ₁ = −lr; m̂₂ = 0.09 g / 0.19, v̂₂ = 0.000999 g² / 0.001999."""
    gaussians = some_gaussians()
    before = gaussians.clone()
    adam = Adam(gaussians, LearningRates(), schedule=Schedule(10), extent=1.0)
    one_step(adam, gaussians, 1, regulariser=3.0)
    first = gaussians.opacity_logits - before.opacity_logits
    torch.testing.assert_close(first, torch.full((5,), -0.05))
    assert gaussians.opacity_logits.grad is None
    one_step(adam, gaussians, 2, regulariser=0.0)
    second = gaussians.opacity_logits - before.opacity_logits - first
    expected = -0.05 * (0.09 / 0.19) / math.sqrt(0.000999 / 0.001999)
    torch.testing.assert_close(second, torch.full((5,), expected), rtol=1e-4, atol=1e-7)
    assert torch.equal(gaussians.means, before.means)


def test_moments_follow_the_rows_and_new_rows_start_at_zero():
    gaussians = some_gaussians()
    adam = Adam(gaussians, LearningRates(), schedule=Schedule(10), extent=1.0)
    for moments in (adam.exp_avg, adam.exp_avg_sq):
        for name, parameter in gaussians.parameters().items():
            moments[name] = parameter.clone()  # row i of the moment identifies Gaussian i
    index = torch.tensor([4, 0, 2, 2])
    fresh = torch.tensor([False, False, False, True])
    selected = gaussians.select(index)
    adam.select(index, fresh)
    for moments in (adam.exp_avg, adam.exp_avg_sq):
        for name, parameter in selected.parameters().items():
            assert torch.equal(moments[name][:3], parameter[:3])
            assert not moments[name][3].any()


def some_camera() -> Camera:
    """A camera whose parameters all differ, looking along a slanted axis at the origin."""
    pose = torch.eye(4)[:3]
    pose[:, :3] = torch.linalg.qr(torch.tensor([[9.0, 1, 2], [-1, 8, 1], [-2, 1, 9]]))[0]
    pose[:, :3] *= pose[:, :3].det()
    pose[:, 3] = torch.tensor([0.2, -0.1, 3.0])
    return Camera(64, 48, 50.0, 60.0, 30.0, 25.0, pose.double())


def optimizer_and_gradient(**options: bool) -> tuple[Gaussians, Adam, ViewGradient]:
    """Gaussians, some of them visible; an optimiser with moments; the gradient of one view."""
    generator = torch.Generator().manual_seed(5)
    gaussians = some_gaussians(40)
    gaussians.log_scales -= 2.0
    adam = Adam(gaussians, LearningRates(), schedule=Schedule(30), extent=2.0, **options)
    for name in gaussians.parameters():
        adam.exp_avg[name].normal_(std=0.1, generator=generator)
        adam.exp_avg_sq[name].uniform_(0.01, 0.1, generator=generator)
    splats = project(gaussians, some_camera(), 1)
    assert 10 < len(splats) < 40
    splats.packed.grad = torch.randn(splats.packed.shape, generator=generator)
    counts = torch.zeros(6, dtype=torch.int32)
    return gaussians, adam, ViewGradient(splats, some_camera(), 1, torch.tensor([True]), counts)


@pytest.mark.parametrize("visible_only", [False, True])
def test_a_step_equals_the_reference(visible_only):
    gaussians, adam, gradient = optimizer_and_gradient(visible_only=visible_only)
    # The gradient of a regulariser.
    gaussians.log_scales.grad = torch.ones_like(gaussians.log_scales)
    expected = {name: p.clone() for name, p in gaussians.parameters().items()}
    expected["log_scales"].grad = torch.ones_like(gaussians.log_scales)
    means, squares = (
        {name: moment.clone() for name, moment in moments.items()}
        for moments in (adam.exp_avg, adam.exp_avg_sq)
    )
    splats = gradient.splats
    reference.adam_step(
        Gaussians(**expected),
        ops.Moments(means, squares),
        ops.SplatGradient.of(splats),
        ops.View(some_camera().cam_from_world, 64, 48, 50.0, 60.0, 30.0, 25.0, sh_degree=1),
        ops.AdamRates(adam.rates_at(7), 7),
        visible_only=visible_only,
    )
    adam.step(gaussians, [gradient], 7)
    for name, parameter in gaussians.parameters().items():
        torch.testing.assert_close(parameter, expected[name], rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(adam.exp_avg[name], means[name], rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(adam.exp_avg_sq[name], squares[name], rtol=1e-3, atol=1e-3)
        assert parameter.grad is None
    assert not gradient.nonfinite_rows.any()


def test_rows_that_the_view_does_not_see_move_by_default():
    gaussians, adam, gradient = optimizer_and_gradient()
    before = gaussians.means.clone()
    adam.step(gaussians, [gradient], 1)
    unseen = torch.ones(len(gaussians), dtype=torch.bool)
    unseen[gradient.splats.ids.long()] = False
    assert (gaussians.means[unseen] != before[unseen]).all()


def test_an_invalid_step_changes_nothing():
    gaussians, adam, gradient = optimizer_and_gradient()
    before = gaussians.clone()
    gradient.valid.fill_(False)
    adam.step(gaussians, [gradient], 1)
    for name, parameter in before.parameters().items():
        assert torch.equal(gaussians.parameters()[name], parameter)


def test_nonfinite_rows_are_counted():
    gaussians, adam, gradient = optimizer_and_gradient()
    gradient.splats.packed.grad[3, 0] = math.nan  # ∂L/∂mean2d
    adam.step(gaussians, [gradient], 1)
    assert gradient.nonfinite_rows[0] == 1
    assert gradient.nonfinite_rows[3] == 0  # the opacity does not depend on it


def test_zero_clears_the_moments_of_one_parameter():
    gaussians = some_gaussians()
    adam = Adam(gaussians, LearningRates(), schedule=Schedule(10), extent=1.0)
    for moments in (adam.exp_avg, adam.exp_avg_sq):
        for moment in moments.values():
            moment.fill_(1.0)
    adam.zero("opacity_logits")
    for moments in (adam.exp_avg, adam.exp_avg_sq):
        zeroed = {name for name, moment in moments.items() if not moment.any()}
        assert zeroed == {"opacity_logits"}


def test_state_is_loaded_as_copies():
    adam = Adam(some_gaussians(5), LearningRates(), schedule=Schedule(10), extent=1.0)
    adam.exp_avg["means"].normal_()
    adam.exp_avg_sq["quats"].normal_()
    state = adam.state_tensors()
    assert len(state) == 12
    other = Adam(some_gaussians(3), LearningRates(), schedule=Schedule(10), extent=1.0)
    other.load_state(state)
    for name in adam.exp_avg:
        assert torch.equal(other.exp_avg[name], adam.exp_avg[name])
        assert torch.equal(other.exp_avg_sq[name], adam.exp_avg_sq[name])
    adam.exp_avg["means"].zero_()
    assert other.exp_avg["means"].any()


def test_rates_follow_the_schedule_of_the_training():
    adam = Adam(
        some_gaussians(), LearningRates(means_steps=1.0), schedule=Schedule(200), extent=5.0
    )
    assert adam.rates_at(200)["means"] == pytest.approx(5 * 1.6e-6)
    assert math.log10(adam.rates_at(100)["means"] / 5) == pytest.approx(math.log10(1.6e-5))
