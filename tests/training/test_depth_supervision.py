"""Depth maps in the loss: the term, a scene without texture, maps that are wrong."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from snowsplat import Trainer, recipe
from snowsplat.data.dataset import Dataset
from snowsplat.scene.render import render
from snowsplat.training.parts.depth_supervision import CHECK_FROM, DepthSupervision, depth_term

from .sphere import cameras, dataset, resumed_with_the_same_bits, z_of_sphere

CONFIG = replace(
    recipe("default", iterations=60, init="points", max_gaussians=600, transients="off", sky=False),
    coarse_to_fine=(0.3, 0.5),
    few_passes=0.0,
    depth_weight=1.0,
)


def random_view() -> tuple[Tensor, Tensor, Tensor]:
    """Depth and alpha (5, 6) of a rendering, and a map with unknown pixels, in float64."""
    generator = torch.Generator().manual_seed(0)
    alpha, z, factor = torch.rand(3, 5, 6, generator=generator, dtype=torch.float64)
    alpha, z = 0.1 + 0.9 * alpha, 2.0 + z
    target = (2.5 / z) * (0.8 + 0.4 * factor)
    target[0, :3] = 0.0
    return alpha * z, alpha, target


def test_the_term_is_its_formula() -> None:
    depth, alpha, target = random_view()
    term, error = depth_term(depth, alpha, target, 1 / 2.5)
    d = 2.5 * alpha / depth
    # The scale with the least sum of weighted squares, by search.
    known = (target > 0) * alpha
    weights = known / (1 + ((d - target) / 0.03) ** 2)
    scales = torch.linspace(0.95, 1.05, 20_001, dtype=torch.float64)
    squares = (weights * (d - scales[:, None, None] * target) ** 2).sum((1, 2))
    r = (d - scales[squares.argmin()] * target).abs()
    expected = (known * 0.03 * torch.log(1 + r / 0.03)).mean()
    torch.testing.assert_close(term, expected, rtol=1e-4, atol=0.0)
    torch.testing.assert_close(error, r[(target > 0) & (alpha > 0.5)].median(), rtol=1e-3, atol=0.0)


def test_the_gradient_is_that_of_a_fixed_scale() -> None:
    """At the limits of the scale, it does not depend on the rendering."""
    depth, alpha, target = random_view()
    weight = alpha.clone()

    def term(depth: Tensor, alpha: Tensor) -> Tensor:  # `alpha` as a weight is constant
        d = 2.5 * alpha / depth
        r = (d - 1.05 * (0.5 * target)).abs()
        return ((target > 0) * weight * 0.03 * torch.log1p(r / 0.03)).mean()

    leaves = [depth.requires_grad_(), alpha.requires_grad_()]
    assert torch.autograd.gradcheck(term, leaves)
    found = torch.autograd.grad(depth_term(*leaves, 0.5 * target, 1 / 2.5)[0], leaves)
    for one, other in zip(found, torch.autograd.grad(term(*leaves), leaves), strict=True):
        torch.testing.assert_close(one, other)


def test_pixels_without_rendering_or_map_have_no_gradient() -> None:
    nothing = torch.zeros(4, 4, requires_grad=True)
    alpha = torch.zeros(4, 4, requires_grad=True)
    for target in (torch.ones(4, 4), torch.zeros(4, 4)):
        term, error = depth_term(nothing, alpha, target, 1.0)
        grads = torch.autograd.grad(term, [nothing, alpha])
        assert all(grad.isfinite().all() and not grad.any() for grad in grads)
        assert float(error) == -1.0


def depth_error(trainer: Trainer) -> float:
    """The mean relative error of the depths in all views."""
    errors = []
    for camera in cameras():
        shown = render(trainer.gaussians, camera, with_depth=True)
        ratio = shown.depth / shown.alpha / z_of_sphere(camera)
        errors.append((ratio - 1.0).abs()[ratio.isfinite() & (shown.alpha > 0.5)])
    return float(torch.cat(errors).mean())


def trained(data: Dataset, **settings) -> tuple[Trainer, list[str]]:
    lines: list[str] = []
    trainer = Trainer(data, replace(CONFIG, **settings), note=lambda line: lines.append(str(line)))
    trainer.run()
    return trainer, lines


def test_maps_of_any_scale_and_shift_give_the_depth_of_a_sphere_of_one_grey(tmp_path) -> None:
    data = dataset(tmp_path, "disparity")
    trainer, lines = trained(data)
    without, _ = trained(data, depth_weight=0.0)
    assert any("depth maps: 6 of 6 photos" in line for line in lines)
    assert depth_error(trainer) < 0.7 * depth_error(without)


def test_without_maps_nothing_changes(tmp_path) -> None:
    data = dataset(tmp_path)
    data = replace(data, train=[replace(view, depth=None) for view in data.train])
    one, lines = trained(data, iterations=8)
    other, _ = trained(data, iterations=8, depth_weight=0.0)
    part = one.part(DepthSupervision)
    assert part.idle
    assert not one.runner.with_depth
    assert torch.equal(one.gaussians.means, other.gaussians.means)
    (line,) = (line for line in lines if "depth" in line)
    assert "depth_weight has no effect" in line


def test_maps_that_are_damaged_or_of_something_else_are_left_out(tmp_path) -> None:
    data = dataset(tmp_path, "z")
    data.train[1].depth.write_bytes(b"no array")
    random = np.random.default_rng(0).uniform(1, 9, (96, 96)).astype(np.float32)
    np.save(data.train[2].depth, random)
    trainer, lines = trained(data, iterations=8)
    assert trainer.part(DepthSupervision).used.tolist() == [True, False, False, True, True, True]
    (line,) = (line for line in lines if line.startswith("depth maps"))
    assert "4 of 6 photos" in line
    assert "cannot be read as a depth map" in line


def test_a_map_that_contradicts_the_photos_is_dropped_and_named(tmp_path) -> None:
    """Without points, the maps are taken as they are; one of them is ten times too far."""
    data = dataset(tmp_path, "z")
    np.save(data.train[4].depth, 10.0 * np.load(data.train[4].depth))
    lines: list[str] = []
    trainer = Trainer(data, CONFIG, note=lambda line: lines.append(str(line)))
    part = trainer.part(DepthSupervision)
    part.errors[:] = torch.tensor([0.01, 0.005, -1.0, 0.01, 0.9, 0.01])
    trainer.step = round(CHECK_FROM * 60) - 1
    part.between(trainer)
    assert part.used.all()
    trainer.schedule.iterations, trainer.step = 200, 100
    part.between(trainer)
    assert part.used.tolist() == [True, True, True, True, False, True]
    assert lines[-1].endswith("not used any more: 4")


def test_a_resumed_run_has_the_same_bits(tmp_path) -> None:
    data, config = dataset(tmp_path), replace(CONFIG, batch=2)
    resumed_with_the_same_bits(data, config, 4, 8)
