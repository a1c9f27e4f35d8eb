"""Adaptive density control on hand-made Gaussians and gradients; section 5.2 of the paper."""

import math

import pytest
import torch

from snowsplat.ops.splats import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.training.density.adaptive import (
    RESET_OPACITY,
    RESET_RECOVERY,
    SPLIT_SHRINK,
    AdaptiveDensity,
    AdaptiveDensityControl,
)
from snowsplat.training.settings.rates import LearningRates
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.step.finite import Diverged
from snowsplat.training.step.optim import Adam
from snowsplat.training.step.view_gradient import ViewGradient

EXTENT = 10.0  # with percent_dense = 0.01: scales up to 0.1 are cloned, larger ones split
#: φ of section 5.2. It is not imported, so that the tests detect a changed value.
PHI = 1.6


def gaussians_of(scales: list[float], opacity: float = 0.5) -> Gaussians:
    """One Gaussian per scale, in a row along x; ``sh_dc`` identifies each."""
    n = len(scales)
    generator = torch.Generator().manual_seed(1)
    return Gaussians(
        means=torch.tensor([[float(i), 0.0, 0.0] for i in range(n)]),
        log_scales=torch.tensor(scales).log()[:, None].repeat(1, 3),
        quats=torch.randn(n, 4, generator=generator),
        opacity_logits=torch.full((n,), math.log(opacity / (1 - opacity))),
        sh_dc=torch.arange(float(n))[:, None, None].repeat(1, 1, 3),
        sh_rest=torch.zeros(n, 0, 3),
    )


def names(gaussians: Gaussians) -> list[int]:
    """The indices of the original Gaussians from which these were made, in ascending order."""
    return sorted(int(name) for name in gaussians.sh_dc[:, 0, 0])


def set_up(
    gaussians: Gaussians, iterations: int = 30_000, random_init: bool = False, **settings: object
) -> tuple[AdaptiveDensityControl, Adam]:
    control = AdaptiveDensityControl.begin(
        AdaptiveDensity(**settings),  # type: ignore[arg-type]
        len(gaussians),
        schedule=Schedule(iterations),
        extent=EXTENT,
        random_init=random_init,
        generator=torch.Generator().manual_seed(0),
    )
    adam = Adam(gaussians, LearningRates(), schedule=Schedule(30_000), extent=EXTENT)
    for moments in (adam.exp_avg, adam.exp_avg_sq):
        for moment in moments.values():
            moment.fill_(1.0)
    return control, adam


def seen(control: AdaptiveDensityControl, grads: list[float]) -> None:
    control.grad_sum, control.views = torch.tensor(grads), torch.ones(len(grads))


def view(
    ids: list[int],
    grad: list[list[float]],
    size: tuple[int, int] = (10, 10),
    radii: list[float] | None = None,
    valid: bool | None = None,
) -> ViewGradient:
    """The position gradient of one backward pass, in an image of ``size``."""
    n = len(ids)
    ones = torch.ones(n)
    splats = Splats2D.pack(
        torch.zeros(n, 2),
        torch.ones(n, 3),
        ones,
        ones,
        torch.zeros(n, 3),
        torch.tensor(radii) if radii else ones,
        torch.tensor(ids, dtype=torch.int32),
    )
    splats.packed.grad = torch.zeros_like(splats.packed)
    splats.packed.grad[:, :2] = torch.tensor(grad)
    camera = Camera(*size, 10.0, 10.0, size[0] / 2, size[1] / 2, torch.eye(3, 4).double())
    return ViewGradient(splats, camera, 0, None if valid is None else torch.tensor([valid]))


def test_statistic_is_the_mean_over_views_in_half_image_sizes():
    gaussians = gaussians_of([0.05] * 4)
    control, _ = set_up(gaussians)
    control.after_backward(1, gaussians, view([0, 2], [[3e-6, 0.0], [0.0, 4e-6]], (200, 100)))
    control.after_backward(2, gaussians, view([2, 3], [[3e-6, 4e-6], [1e-6, 0.0]], (100, 50)))
    # Gaussian 2: 4e-6 · 50 in the first view; (3e-6 · 50, 4e-6 · 25) in the second, at half the
    # size.
    expected = [3e-4, 0.0, 2e-4 + math.hypot(1.5e-4, 1e-4), 5e-5]
    torch.testing.assert_close(control.grad_sum, torch.tensor(expected))
    assert control.views.tolist() == [1, 0, 2, 1]


def test_densification_compares_the_mean_over_views_with_the_threshold():
    """Section 5.2: the *average* magnitude of the view-space position gradient above τ_pos.

    Both Gaussians have a gradient norm of 1.5e-4 per view, seen once or three times: a sum of
    4.5e-4 exceeds τ_pos = 2e-4, the mean does not. The third has a mean of 2.5e-4.
    """
    gaussians = gaussians_of([0.05, 0.05, 0.05])
    control, adam = set_up(gaussians)
    below = [1.5e-4 / 50, 0.0]  # of an image 100 wide: times 50 in units of half its width
    control.after_backward(
        1, gaussians, view([0, 1, 2], [below, below, [1e-4 / 50, 0.0]], (100, 100))
    )
    control.after_backward(2, gaussians, view([1, 2], [below, [4e-4 / 50, 0.0]], (100, 100)))
    control.after_backward(3, gaussians, view([1], [below], (100, 100)))
    assert control.grad_sum[1] > 2e-4
    assert names(control.after_step(600, gaussians, adam)) == [0, 1, 2, 2]


def test_the_absolute_gradient_replaces_the_signed_one():
    """The gradients of the tiles of Gaussian 0 cancel; Gaussian 1 touches one tile."""
    gaussians = gaussians_of([0.05, 0.05])
    signed, absolute = [[0.0, 0.0], [1e-4, -1e-4]], [[4e-4, 3e-4], [1e-4, 1e-4]]
    for settings, sums in (
        ({}, [0.0, math.hypot(1e-4, 1e-4)]),
        ({"abs_grad": True}, [5e-4, math.hypot(1e-4, 1e-4)]),
    ):
        control, adam = set_up(gaussians.clone(), **settings)
        gradient = view([0, 1], signed, size=(2, 2))
        gradient.splats.abs_grad = torch.tensor(absolute)
        control.after_backward(1, gaussians, gradient)
        torch.testing.assert_close(control.grad_sum, torch.tensor(sums))
        refined = control.after_step(600, gaussians.clone(), adam)
        assert names(refined) == ([0, 0, 1] if settings else [0, 1])


def test_an_unseen_gaussian_has_no_gradient():
    gaussians = gaussians_of([0.05, 0.05])
    control, adam = set_up(gaussians, grad_threshold=0.0)
    control.after_backward(1, gaussians, view([1], [[1.0, 0.0]]))
    assert names(control.after_step(600, gaussians, adam)) == [0, 1, 1]


def test_the_papers_constants():
    settings = AdaptiveDensity()
    assert SPLIT_SHRINK == PHI
    assert settings.grad_threshold == 2e-4
    assert not settings.abs_grad
    assert settings.prune_opacity == 0.005
    assert settings.percent_dense == 0.01
    assert (settings.densify_from, settings.densify_until) == (500, 15_000)
    assert (settings.densify_interval, settings.opacity_reset_interval) == (100, 3000)
    assert (settings.prune_world_size, settings.prune_screen_size) == (0.1, 20.0)
    assert (settings.max_gaussians, settings.reset_random_start) == (0, True)
    assert (RESET_OPACITY, RESET_RECOVERY) == (0.01, 500)


@pytest.mark.parametrize(("setting", "expected"), [(20.0, 9.0), (0.5, 9.0), (0.0, 0.0)])
def test_the_largest_radius_is_collected_if_it_is_pruned_by(setting, expected):
    gaussians = gaussians_of([0.05])
    control, _ = set_up(gaussians, prune_screen_size=setting)
    for radius in (7.0, 9.0, 8.0):
        control.after_backward(1, gaussians, view([0], [[1.0, 0.0]], radii=[radius]))
    assert control.max_radii.tolist() == [expected]


def test_statistics_end_with_densification():
    gaussians = gaussians_of([0.05])
    control, _ = set_up(gaussians, densify_until=10)
    control.after_backward(11, gaussians, view([0], [[1.0, 1.0]]))
    assert not control.views.any()
    control.after_backward(10, gaussians, view([0], [[1.0, 1.0]]))
    assert control.views.tolist() == [1]


def test_an_invalid_step_leaves_the_statistics_unchanged():
    gaussians = gaussians_of([0.05])
    control, _ = set_up(gaussians)
    control.after_backward(1, gaussians, view([0], [[1.0, 1.0]], valid=False))
    assert not any(statistic.any() for statistic in control.state_tensors().values())
    control.after_backward(1, gaussians, view([0], [[1.0, 1.0]], valid=True))
    assert all(statistic.any() for statistic in control.state_tensors().values())


def test_statistics_are_loaded_as_copies():
    gaussians = gaussians_of([0.05, 0.05])
    control, _ = set_up(gaussians)
    control.after_backward(1, gaussians, view([1], [[1.0, 1.0]], radii=[3.0]))
    other, _ = set_up(gaussians)
    other.load_state(control.state_tensors())
    expected = {name: tensor.clone() for name, tensor in control.state_tensors().items()}
    control.after_backward(2, gaussians, view([1], [[1.0, 1.0]], radii=[4.0]))
    assert expected.keys() == {"grad_sum", "views", "max_radii"}
    for name, tensor in other.state_tensors().items():
        assert torch.equal(tensor, expected[name]), name
        assert tensor.any()


def test_small_gaussians_are_cloned_large_ones_are_split_others_unchanged():
    gaussians = gaussians_of([0.05, 0.5, 0.05, 0.5])
    before = gaussians.clone()
    control, adam = set_up(gaussians)
    seen(control, [3e-4, 3e-4, 1e-4, 1e-4])
    refined = control.after_step(600, gaussians, adam)

    assert names(refined) == [0, 0, 1, 1, 2, 3]
    rows = {name: (refined.sh_dc[:, 0, 0] == name).nonzero()[:, 0] for name in range(4)}
    for name in (0, 2, 3):  # kept, and cloned in the same place
        assert torch.equal(refined.means[rows[name]], before.means[[name] * len(rows[name])])
        assert torch.equal(
            refined.log_scales[rows[name]], before.log_scales[[name] * len(rows[name])]
        )
    children = refined.select(rows[1])
    assert (children.means != before.means[1]).all()
    assert not torch.equal(children.means[0], children.means[1])
    torch.testing.assert_close(children.scales, torch.full((2, 3), 0.5 / PHI))
    assert torch.equal(children.quats, before.quats[[1, 1]])
    # The original of a clone keeps its moments, so it moves away from its copy. Copies and
    # children have no moments.
    moments = adam.exp_avg["means"][:, 0]
    assert sorted(moments[rows[0]].tolist()) == [0.0, 1.0]
    assert moments[rows[1]].tolist() == [0.0, 0.0]
    assert moments[rows[2]].tolist() == [1.0]
    # The statistics have the new number of rows and start from zero.
    for statistic in control.state_tensors().values():
        assert statistic.shape == (6,)
        assert not statistic.any()


def test_children_are_drawn_from_their_parent():
    """The positions of 4000 children, whitened by the parent's covariance, are standard normal."""
    n = 2000
    parent = gaussians_of([0.5])
    parent.means[0] = torch.tensor([30.0, -20.0, 10.0])
    parent.log_scales[0] = torch.tensor([2.0, 0.4, 0.1]).log()
    gaussians = parent.select(torch.zeros(n, dtype=torch.int64))
    control, adam = set_up(gaussians)
    seen(control, [1.0] * n)
    refined = control.after_step(600, gaussians, adam)
    assert len(refined) == 2 * n
    rotation = rotation_from_quat(parent.quats[0])
    white = (refined.means - parent.means[0]) @ rotation / parent.scales[0]
    torch.testing.assert_close(white.mean(dim=0), torch.zeros(3), atol=0.08, rtol=0)
    torch.testing.assert_close(white.T.cov(), torch.eye(3), atol=0.1, rtol=0)


def test_children_depend_on_the_generator_of_the_control_alone():
    """They do not depend on the global generator of torch, which other code uses, too."""
    scenes = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        gaussians = gaussians_of([0.5])
        control, adam = set_up(gaussians)
        seen(control, [1.0])
        scenes.append(control.after_step(600, gaussians, adam).means)
    assert torch.equal(*scenes)


@pytest.mark.parametrize(
    ("step", "densifies"),
    [(400, False), (500, True), (650, False), (15_000, True), (15_100, False)],
)
def test_the_steps_that_densify(step, densifies):
    gaussians = gaussians_of([0.05])
    control, adam = set_up(gaussians)
    seen(control, [1.0])
    refined = control.after_step(step, gaussians, adam)
    assert len(refined) == 1 + densifies
    assert bool(control.views.any()) == (not densifies)


def test_thresholds_are_exclusive():
    """Only gradients above τ, opacities below ε and scales above the limit count.

    All of these values are exact in binary.
    """
    gaussians = gaussians_of([2.5, 2.5, 3.0, 2.5])
    gaussians.opacity_logits[:] = torch.tensor([0.0, 0.0, 0.0, -1e-3])  # 0.5, and a little less
    gaussians.log_scales[:2] = math.log(2.5)
    limit = float(gaussians.log_scales[0, 0].exp()) / EXTENT
    control, adam = set_up(
        gaussians, grad_threshold=0.25, percent_dense=limit, prune_opacity=0.5, prune_world_size=0.0
    )
    seen(control, [0.25, 0.5, 0.5, 0.25])
    refined = control.after_step(600, gaussians, adam)
    assert names(refined) == [0, 1, 1, 2, 2]
    by_name = {name: refined.scales[refined.sh_dc[:, 0, 0] == name].max() for name in (1, 2)}
    assert by_name[1] == pytest.approx(2.5)  # cloned
    assert by_name[2] == pytest.approx(3.0 / PHI)  # split


def test_nonfinite_parameters_stop_a_refinement():
    gaussians = gaussians_of([0.05, 0.05])
    gaussians.means[1, 2] = math.nan
    control, adam = set_up(gaussians)
    control.after_step(650, gaussians, adam)  # not a step with densification
    with pytest.raises(Diverged, match=r"^step 600: non-finite Gaussians, means \(1 row\)"):
        control.after_step(600, gaussians, adam)


def test_transparent_gaussians_are_removed():
    gaussians = gaussians_of([0.05] * 4)
    gaussians.opacity_logits[1:3] = math.log(0.004 / 0.996)
    control, adam = set_up(gaussians)
    seen(control, [0.0, 1.0, 1.0, 0.0])  # even where they would be densified
    assert names(control.after_step(600, gaussians, adam)) == [0, 3]


def test_size_pruning_waits_for_the_first_reset():
    def refined(step: int, **settings: object) -> list[int]:
        gaussians = gaussians_of([0.05, 1.1, 0.05])
        control, adam = set_up(gaussians, **settings)
        control.max_radii[2] = 21.0
        return names(control.after_step(step, gaussians, adam))

    assert refined(2900) == [0, 1, 2]
    assert refined(3100) == [0]
    assert refined(3100, prune_world_size=0.0) == [0, 1]
    assert refined(3100, prune_screen_size=0.0) == [0, 2]
    assert refined(3100, opacity_reset_interval=0) == [0, 1, 2]


def test_a_split_is_judged_by_the_size_of_its_children():
    gaussians = gaussians_of([1.5, 1.7])  # children of 0.94 and 1.06; the limit is 1.0
    control, adam = set_up(gaussians)
    seen(control, [1.0, 1.0])
    assert names(control.after_step(3100, gaussians, adam)) == [0, 0]


def test_the_cap_lets_the_largest_gradients_go_first():
    gaussians = gaussians_of([0.05, 0.05, 0.5, 0.5, 0.05])
    control, adam = set_up(gaussians, max_gaussians=7)
    seen(control, [3e-4, 9e-4, 5e-4, 8e-4, 0.0])
    refined = control.after_step(600, gaussians, adam)
    assert names(refined) == [0, 1, 1, 2, 3, 3, 4]
    seen(control, [1.0] * 7)
    assert len(control.after_step(700, refined, adam)) == 7


@pytest.mark.parametrize(("limit", "count"), [(0, 2), (1, 1), (2, 2)])
def test_small_limits(limit, count):
    gaussians = gaussians_of([0.05])
    control, adam = set_up(gaussians, max_gaussians=limit)
    seen(control, [1.0])
    assert len(control.after_step(600, gaussians, adam)) == count


def test_opacity_reset_and_its_moments():
    gaussians = gaussians_of([0.05, 0.05])
    gaussians.opacity_logits[1] = math.log(0.006 / 0.994)
    control, adam = set_up(gaussians)
    reset = control.after_step(3000, gaussians, adam)
    assert reset.opacities.tolist() == pytest.approx([RESET_OPACITY, 0.006])
    assert not adam.exp_avg["opacity_logits"].any()
    assert not adam.exp_avg_sq["opacity_logits"].any()
    assert adam.exp_avg["means"].any()


def test_when_opacity_is_reset():
    def resets(steps: range, **settings: object) -> list[int]:
        control, _ = set_up(gaussians_of([0.05]), **settings)
        return [step for step in steps if control._resets_at(step)]

    every_hundred = range(0, 30_001, 100)
    assert resets(every_hundred[1:]) == [3000, 6000, 9000, 12_000]
    assert resets(every_hundred[1:], random_init=True)[:2] == [500, 3000]
    assert resets(every_hundred[1:], random_init=True, reset_random_start=False)[0] == 3000
    assert resets(every_hundred[1:], random_init=True, iterations=900) == []
    assert resets(every_hundred[1:], densify_until=6400) == [3000]
    assert resets(every_hundred[1:], opacity_reset_interval=0) == []
    assert resets(range(1, 4), opacity_reset_interval=1) == [1, 2, 3]
    # At least 500 steps remain for recovery: of densification, or of the training at the start.
    assert resets(every_hundred[1:], densify_until=3500) == [3000]
    assert resets(every_hundred[1:], densify_until=3499) == []
    assert resets(every_hundred[1:], random_init=True, iterations=1000) == [500]
    assert resets(every_hundred[1:], random_init=True, iterations=999) == []


@pytest.mark.parametrize(("interval", "left"), [(25, [4, 4, 2]), (100, [4, 2, 2])])
def test_pruning_waits_until_opacities_could_recover_from_a_reset(interval, left):
    """With a short interval, all Gaussians of a random start were removed directly after it."""
    gaussians = gaussians_of([0.05] * 4)
    control, adam = set_up(
        gaussians,
        random_init=True,
        prune_opacity=0.1,
        densify_from=interval,
        densify_interval=interval,
    )
    gaussians = control.after_step(interval, gaussians, adam)
    assert float(gaussians.opacities.max()) == pytest.approx(RESET_OPACITY)
    found = [len(gaussians)]
    gaussians.opacity_logits[:2] = 0.0  # half of them are needed
    for step in (2 * interval, 8 * interval):
        gaussians = control.after_step(step, gaussians, adam)
        found.append(len(gaussians))
    assert found == left


def test_a_scene_never_becomes_empty():
    gaussians = gaussians_of([0.05] * 3, opacity=0.001)
    control, adam = set_up(gaussians)
    assert len(control.after_step(600, gaussians, adam)) == 3


def test_rows_are_kept_in_morton_order():
    generator = torch.Generator().manual_seed(3)
    gaussians = gaussians_of([0.05] * 500)
    gaussians.means.copy_(torch.rand(500, 3, generator=generator))
    control, adam = set_up(gaussians)
    adam.exp_avg["means"].copy_(gaussians.means)
    refined = control.after_step(600, gaussians, adam)
    assert torch.equal(adam.exp_avg["means"], refined.means)  # the moments are reordered too
    steps = (refined.means[1:] - refined.means[:-1]).norm(dim=1).median()
    assert steps < 0.2


def test_fractions_scale_with_the_training_and_steps_do_not():
    gaussians = gaussians_of([0.05])
    control, _ = set_up(gaussians, iterations=3000, densify_from=100, densify_until=0.5)
    assert (control.first, control.last) == (100, 1500)
    control, _ = set_up(gaussians, iterations=7000)
    assert (control.first, control.last) == (500, 7000)
