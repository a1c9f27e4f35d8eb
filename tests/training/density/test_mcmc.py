"""MCMC density control: eq. 8 and 9 of Kheradmand et al. 2024, regularisers, growth and limit."""

import math

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from snowsplat.ops.splats import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order, rotation_from_quat
from snowsplat.training.density.mcmc import (
    NOISE_SHARPNESS,
    USUAL_EXTENT,
    McmcDensity,
    McmcDensityControl,
    positions_at,
    shared_opacity,
)
from snowsplat.training.settings.rates import LearningRates
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.step.finite import Diverged
from snowsplat.training.step.optim import Adam
from snowsplat.training.step.view_gradient import ViewGradient


def some_gaussians(n: int, opacity: float = 0.5) -> Gaussians:
    generator = torch.Generator().manual_seed(n)
    return Gaussians(
        means=torch.rand(n, 3, generator=generator),
        log_scales=torch.rand(n, 3, generator=generator) - 3.0,
        quats=torch.randn(n, 4, generator=generator),
        opacity_logits=torch.full((n,), math.log(opacity / (1 - opacity))),
        sh_dc=torch.arange(float(n))[:, None, None].repeat(1, 1, 3),
        sh_rest=torch.zeros(n, 0, 3),
    )


def set_up(gaussians: Gaussians, **settings: object) -> tuple[McmcDensityControl, Adam]:
    control = McmcDensityControl.begin(
        McmcDensity(**settings),  # type: ignore[arg-type]
        len(gaussians),
        schedule=Schedule(30_000),
        extent=1.0,
        random_init=False,
        generator=torch.Generator().manual_seed(0),
    )
    adam = Adam(gaussians, LearningRates(means_steps=1.0), schedule=Schedule(30_000), extent=1.0)
    for moments in (adam.exp_avg, adam.exp_avg_sq):
        for moment in moments.values():
            moment.fill_(1.0)
    return control, adam


@pytest.mark.parametrize("copies", [1, 2, 3, 7, 51])
@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
def test_equation_9_as_the_paper_writes_it(opacity, copies):
    """Compared with the double sum of the paper, computed term by term."""
    new, shrink = shared_opacity(
        torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies])
    )
    assert float(new) == pytest.approx(1 - (1 - opacity) ** (1 / copies), rel=1e-9)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * float(new) ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, copies + 1)
        for k in range(i)
    )
    assert float(shrink) == pytest.approx(opacity / total, rel=1e-6)


def test_opaque_gaussians_and_many_copies_stay_finite():
    new, shrink = shared_opacity(torch.tensor([1.0, 1.0, 1e-6]), torch.tensor([51, 1000, 1000]))
    assert ((new > 0) & (new < 1)).all()
    assert ((shrink > 0) & (shrink <= 1.001)).all()


def test_equation_9_stays_on_its_device():
    """The tensors are fake; an operation that mixes devices raises an error."""
    with FakeTensorMode():
        opacities = torch.rand(5, device="cuda")
        copies = torch.ones(5, dtype=torch.int64, device="cuda")
        assert [part.device.type for part in shared_opacity(opacities, copies)] == ["cuda", "cuda"]


def test_copies_keep_the_integral_along_a_line():
    """The derivation of eq. 9: along a line, N copies together absorb as much as the original."""
    opacity, copies = 0.8, 4
    new, shrink = shared_opacity(
        torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies])
    )
    x = torch.linspace(-12, 12, 100_001, dtype=torch.float64)
    alone = opacity * torch.exp(-0.5 * x**2)
    together = 1 - (1 - new * torch.exp(-0.5 * (x / shrink) ** 2)) ** copies
    torch.testing.assert_close(together.max(), alone.max())
    torch.testing.assert_close(torch.trapezoid(together, x), torch.trapezoid(alone, x))


def test_dead_gaussians_are_relocated_to_live_ones():
    gaussians = some_gaussians(200)
    dead = torch.arange(200) % 4 == 0
    gaussians.opacity_logits[dead] = -6.0
    gaussians.means[0] = torch.nan  # dead ones may be non-finite
    control, adam = set_up(gaussians, max_gaussians=200)
    total = gaussians.opacities[~dead].double()
    refined = control._relocate(gaussians, adam)

    assert len(refined) == 200
    sources = refined.sh_dc[:, 0, 0].long()
    assert not dead[sources].any()
    assert refined.means.isfinite().all()
    copies = torch.bincount(sources, minlength=200)
    assert (copies[~dead] >= 1).all()
    # All copies in one place are together as opaque as the original. Their moments are 0.
    together = 1 - (1 - refined.opacities.double()) ** copies[sources]
    torch.testing.assert_close(together, total.new_full((200,), 0.5), atol=1e-5, rtol=0)
    crowded = copies[sources] > 1
    for moments in (adam.exp_avg, adam.exp_avg_sq):
        for moment in moments.values():
            assert not moment[crowded].any()
            assert (moment[~crowded] == 1).all()


def test_sources_are_drawn_by_opacity():
    gaussians = some_gaussians(3000, opacity=0.9)
    gaussians.opacity_logits[1000:] = math.log(0.1 / 0.9)
    gaussians.opacity_logits[2000:] = -6.0
    control, adam = set_up(gaussians, max_gaussians=3000)
    refined = control._relocate(gaussians, adam)
    copies = torch.bincount(refined.sh_dc[:, 0, 0].long(), minlength=3000) - 1
    share = float(copies[:1000].sum()) / 1000
    assert share == pytest.approx(0.9, abs=0.04)


def test_positions_by_weight():
    weights = torch.tensor([0.0, 0.5, 0.25, 0.0, 0.25])
    share = torch.tensor([0.0, 0.49, 0.5, 0.74, 0.75, 1.0 - 2**-53], dtype=torch.float64)
    assert positions_at(weights, share).tolist() == [1, 1, 2, 2, 4, 4]
    many = torch.full((1000,), 1.0 - 2**-24)
    assert positions_at(many, share)[-1] == 999


def test_growth_up_to_the_limit():
    gaussians = some_gaussians(100)
    control, adam = set_up(gaussians, max_gaussians=112, densify_from=0)
    counts = []
    for step in range(100, 600, 100):
        gaussians = control.after_step(step, gaussians, adam)
        assert adam.exp_avg["means"].shape == gaussians.means.shape
        counts.append(len(gaussians))
    assert counts == [105, 110, 112, 112, 112]


@pytest.mark.parametrize("on_gpu", [False, True])
def test_noise_follows_the_covariance_of_transparent_gaussians(on_gpu):
    """Eq. 8: the noise is Σ η = R diag(s²) Rᵀ η, with standard normal η."""
    n = 4000
    one = some_gaussians(1, opacity=0.001)
    one.log_scales[0] = torch.tensor([0.3, 0.1, 0.02]).log()
    gaussians = one.select(torch.zeros(n, dtype=torch.int64))
    opaque = one.clone()
    opaque.opacity_logits[:] = 2.0
    gaussians = gaussians.append(opaque)
    before = gaussians.clone()
    control, _ = set_up(gaussians)
    if on_gpu:
        control._add_noise_of_rows(gaussians, 1e-5 * 5e5)
    else:
        control._add_noise(gaussians, rate=1e-5)
    moved = gaussians.means - before.means
    assert not moved[n].any()  # the opaque one has no noise
    gate = 1 / (1 + math.exp(-100 * (0.005 - 0.001)))
    rotation = rotation_from_quat(one.quats[0])
    deviations = ((moved[:n] @ rotation) / (1e-5 * 5e5 * gate)).std(dim=0)
    torch.testing.assert_close(deviations, one.scales[0] ** 2, rtol=0.06, atol=0)


def test_the_constants_of_the_paper():
    settings = McmcDensity()
    assert (settings.densify_from, settings.densify_until) == (500, 25_000)
    assert settings.densify_interval == 100
    assert settings.growth == 0.05
    assert settings.prune_opacity == 0.005
    assert settings.noise == 5e5
    assert (settings.opacity_regularizer, settings.scale_regularizer) == (0.01, 0.01)
    assert NOISE_SHARPNESS == 100.0


@pytest.mark.parametrize(
    ("step", "relocates"),
    [(400, False), (500, True), (550, False), (25_000, True), (25_100, False)],
)
def test_when_gaussians_are_relocated(step, relocates):
    gaussians = some_gaussians(100)
    control, adam = set_up(gaussians)
    assert len(control.after_step(step, gaussians, adam)) == (105 if relocates else 100)


def test_noise_is_scaled_by_the_learning_rate_of_the_means():
    """Noise is added at every step, also at steps without relocation."""
    moved = []
    for step in (7, 30_000):
        gaussians = some_gaussians(50, opacity=0.001)
        before = gaussians.means.clone()
        control, adam = set_up(gaussians)
        control.after_step(step, gaussians, adam)
        moved.append((gaussians.means - before) / adam.rates_at(step)["means"])
    assert moved[0].any()
    torch.testing.assert_close(moved[0], moved[1], rtol=1e-3, atol=0.5)


@pytest.mark.parametrize(("step", "moves"), [(70, True), (71, False)])
def test_noise_ends_at_its_moment(step, moves):
    gaussians = some_gaussians(50, opacity=0.001)
    before = gaussians.means.clone()
    control, adam = set_up(gaussians, noise_until=70)
    control.after_step(step, gaussians, adam)
    assert torch.equal(gaussians.means, before) != moves


def test_gaussians_at_the_opacity_limit_are_dead():
    """If all Gaussians are dead, none can be relocated."""
    gaussians = some_gaussians(10)
    gaussians.opacity_logits[:] = 0.0
    control, adam = set_up(gaussians, prune_opacity=0.5)
    assert control._relocate(gaussians, adam) is gaussians
    gaussians.opacity_logits[3] = 1e-3
    refined = control._relocate(gaussians, adam)
    assert refined.sh_dc[:, 0, 0].tolist() == [3.0] * 10


def test_nothing_to_relocate_and_no_growth_changes_nothing():
    gaussians = some_gaussians(10)
    control, adam = set_up(gaussians, max_gaussians=10)
    assert control._relocate(gaussians, adam) is gaussians
    assert (adam.exp_avg["means"] == 1).all()


def test_the_opacity_of_copies_stays_above_the_limit():
    """Otherwise the copies would be dead at once: with many copies, o_new of eq. 9 is below it."""
    gaussians = some_gaussians(60)
    gaussians.opacity_logits[1:] = -9.0
    gaussians.opacity_logits[0] = math.log(0.02 / 0.98)
    control, adam = set_up(gaussians, max_gaussians=60)
    refined = control._relocate(gaussians, adam)
    assert float(refined.opacities.min()) == pytest.approx(0.005, rel=1e-4)


def test_relocated_rows_are_in_morton_order():
    gaussians = some_gaussians(500)
    control, adam = set_up(gaussians)
    adam.exp_avg["means"].copy_(gaussians.means)
    refined = control._relocate(gaussians, adam)
    assert torch.equal(morton_order(refined.means), torch.arange(len(refined)))
    untouched = adam.exp_avg["means"].any(dim=1)
    assert torch.equal(adam.exp_avg["means"][untouched], refined.means[untouched])


def test_noise_and_sources_depend_on_the_generator_of_the_control_alone():
    scenes = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        gaussians = some_gaussians(50, opacity=0.001)
        gaussians.opacity_logits[:9] = 1.0
        control, adam = set_up(gaussians, max_gaussians=70)
        scenes.append(control.after_step(500, gaussians, adam).means)
    assert torch.equal(*scenes)


def test_nonfinite_parameters_stop_a_relocation():
    gaussians = some_gaussians(10)
    gaussians.quats[4, 1] = math.inf
    control, adam = set_up(gaussians)
    with pytest.raises(Diverged, match=r"^step 500: non-finite Gaussians, quats \(1 row\)"):
        control.after_step(500, gaussians, adam)


def test_regularisers_are_the_gradients_of_mean_opacity_and_scale():
    gaussians = some_gaussians(7)
    control, _ = set_up(gaussians, opacity_regularizer=0.02, scale_regularizer=0.03)
    camera = Camera(10, 10, 10.0, 10.0, 5.0, 5.0, torch.eye(3, 4).double())
    control.after_backward(
        1, gaussians, ViewGradient(Splats2D(torch.zeros(0, 16), None, 3), camera, 0)
    )
    leaves = gaussians.clone()
    leaves.opacity_logits.requires_grad_()
    leaves.log_scales.requires_grad_()
    scale_weight = 0.03 * USUAL_EXTENT / control.extent
    (0.02 * leaves.opacities.mean() + scale_weight * leaves.scales.mean()).backward()
    torch.testing.assert_close(gaussians.opacity_logits.grad, leaves.opacity_logits.grad)
    torch.testing.assert_close(gaussians.log_scales.grad, leaves.log_scales.grad)
