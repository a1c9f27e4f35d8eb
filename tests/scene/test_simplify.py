"""Merging Gaussians: moments, costs, pairs, and pictures that stay the same."""

import math

import pytest
import torch

from snowsplat.evaluation.metrics import psnr
from snowsplat.scene import sight
from snowsplat.scene import simplify as module
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at, rotation_from_quat
from snowsplat.scene.render import render
from snowsplat.scene.simplify import simplify


def scene(n: int, seed: int = 0) -> Gaussians:
    """Flat Gaussians on a smooth, coloured sphere, dense enough to be redundant."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1)
    spacing = math.sqrt(4 * math.pi / n)
    return Gaussians(
        means=means,
        log_scales=torch.tensor([1.0, 1.0, 1.0]).log() + math.log(spacing) + torch.zeros(n, 3),
        quats=torch.randn(n, 4, generator=generator),
        opacity_logits=torch.full((n,), 2.0),
        sh_dc=torch.stack([(3 * means[:, 0]).sin(), means[:, 1], means[:, 2]], 1)[:, None],
        sh_rest=0.02 * torch.randn(n, 3, 3, generator=generator),
    )


CAMERA = Camera(
    *(96, 96, 100.0, 100.0, 48.0, 48.0),
    look_at(torch.tensor([0.0, -1.0, -3.0]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0])),
)


def image(gaussians: Gaussians) -> torch.Tensor:
    return render(gaussians, CAMERA).image


def test_two_gaussians_become_the_gaussian_with_their_moments():
    pair = scene(2).to(dtype=torch.float64)
    pair.opacity_logits[:] = torch.tensor([-1.0, -2.0])
    one = simplify(pair, 1)
    rotation = rotation_from_quat(pair.rotations) * pair.scales[:, None]
    covariances = rotation @ rotation.transpose(1, 2)
    principal = [covariances[:, i, i] * covariances[:, j, j] for i, j in ((0, 1), (1, 2), (2, 0))]
    mixed = [covariances[:, i, j] ** 2 for i, j in ((0, 1), (1, 2), (2, 0))]
    mass = pair.opacities * (sum(principal) - sum(mixed)).sqrt()
    weight = mass / mass.sum()
    mean = weight @ pair.means
    offset = pair.means - mean
    expected = torch.einsum("n,nij->ij", weight, covariances + offset[:, :, None] * offset[:, None])
    axes = rotation_from_quat(one.rotations)[0] * one.scales[0]
    torch.testing.assert_close(one.means[0], mean)
    torch.testing.assert_close(axes @ axes.T, expected)
    torch.testing.assert_close(one.sh_rest[0], torch.einsum("n,nkc->kc", weight, pair.sh_rest))
    minors = torch.stack(
        [torch.linalg.det(expected[[i, j]][:, [i, j]]) for i, j in ((0, 1), (1, 2), (0, 2))]
    )
    # Seen from everywhere, the area is the root of the principal minors. The pair overlaps.
    sums = covariances.sum(0)
    area = torch.stack(
        [torch.linalg.det(sums[[i, j]][:, [i, j]]) for i, j in ((0, 1), (1, 2), (0, 2))]
    )
    apart = pair.means[1] - pair.means[0]
    density = (-apart @ torch.linalg.solve(sums, apart) / 2).exp()
    covered = mass.sum() - mass.prod() / area.sum().sqrt() * density
    torch.testing.assert_close(one.opacities[0] * minors.sum().sqrt(), covered)


def test_equal_gaussians_cost_nothing_and_different_ones_cost_more():
    same = scene(1)
    near, far, red = same.clone(), same.clone(), same.clone()
    near.means += 0.1 * same.scales[0, 0]
    far.means += same.scales[0, 0]
    red.sh_dc += 1.0
    costs = [
        float(module._costs(module._Mixture.from_gaussians(Gaussians.cat([same, other]), []))[0, 0])
        for other in (same, near, far, red)
    ]
    assert costs[0] == pytest.approx(0.0, abs=1e-6)
    assert costs[0] < costs[1] < costs[2]
    assert costs[3] == pytest.approx(0.3 * 3.0 * math.sqrt(2 * float(same.opacities)), rel=1e-5)


def test_the_pairs_are_the_greedy_choice():
    generator = torch.Generator().manual_seed(3)
    for case in range(20):
        count, width = 40, 5
        costs = torch.rand(width, count, generator=generator)
        if case % 2:
            costs = (4 * costs).floor()  # ties
        for row in range(width):
            costs[row, count - row - 1 :] = torch.inf
        free, expected = set(range(count)), []
        for edge in costs.flatten().argsort(stable=True).tolist():
            i, j = edge % count, edge % count + edge // count + 1
            if costs[edge // count, i] < torch.inf and {i, j} <= free:
                free -= {i, j}
                expected.append((i, j))
        first, second = module._cheapest_pairs(costs, 9)
        assert list(zip(first.tolist(), second.tolist(), strict=True)) == expected[:9]


def test_a_redundant_scene_looks_the_same():
    whole = scene(4000)
    reference = image(whole)
    for count, decibels in ((2000, 32.0), (1000, 26.0), (400, 22.0)):
        smaller = simplify(whole, count)
        assert len(smaller) == count
        assert psnr(image(smaller), reference) > decibels
        dropped = whole.select(
            torch.randperm(4000, generator=torch.Generator().manual_seed(0))[:count]
        )
        assert psnr(image(smaller), reference) > psnr(image(dropped), reference) + 1.5


def test_gaussians_below_the_size_of_a_pixel_stay_visible(monkeypatch):
    """Their pictures are of the size of a pixel; merged ones must not become transparent."""
    whole = scene(4000)
    whole.log_scales -= 4.0  # from 1.9 to 0.03 pixels
    reference = image(whole)
    with_cameras, without = (image(simplify(whole, 1300, known)) for known in ([CAMERA], []))
    monkeypatch.setattr(sight, "_SPACING", 0.0)
    as_if_sharp = image(simplify(whole, 1300))
    assert psnr(with_cameras, reference) > psnr(without, reference) + 5.0
    assert psnr(without, reference) > psnr(as_if_sharp, reference) + 3.0
    assert float(with_cameras.mean()) > 0.8 * float(reference.mean())


def test_what_the_cameras_do_not_see_is_merged_first():
    whole = scene(2000)
    behind = whole.means @ CAMERA.position.float() < 0
    smaller = simplify(whole, 1500, [CAMERA])
    rows = {tuple(row) for row in smaller.means.tolist()}
    kept = torch.tensor([tuple(row) in rows for row in whole.means.tolist()])
    assert float(kept[~behind].float().mean()) > float(kept[behind].float().mean()) + 0.2


def test_for_views_from_farther_away_gaussians_become_less_opaque():
    whole = scene(500)
    whole.opacity_logits -= 3.0
    whole.log_scales -= 2.0
    near, far = simplify(whole, 250), simplify(whole, 250, farther=4.0)
    assert float(far.opacities.mean()) < float(near.opacities.mean())


def test_gaussians_that_are_not_merged_do_not_change():
    whole = scene(300)
    smaller = simplify(whole, 280)
    rows = {tuple(row) for row in whole.means.tolist()}
    kept = [i for i, row in enumerate(smaller.means.tolist()) if tuple(row) in rows]
    assert len(kept) == 260
    index = [whole.means.tolist().index(smaller.means[i].tolist()) for i in kept]
    for name, tensor in smaller.select(torch.tensor(kept)).parameters().items():
        assert torch.equal(tensor, whole.parameters()[name][index])


def test_small_and_unusual_scenes():
    whole = scene(10)
    assert simplify(whole, 10) is whole
    assert simplify(whole, 99) is whole
    assert len(simplify(whole, 0)) == 0
    whole.means[3] = torch.nan
    assert len(simplify(whole, 9)) == 9
    assert len(simplify(whole, 1)) == 1
    equal = Gaussians.cat([scene(1)] * 50)
    equal.log_scales[:, 2] = -30.0  # flat
    equal.opacity_logits[::2] = -30.0
    (one,) = simplify(equal, 1).means
    torch.testing.assert_close(one, equal.means[0])
    assert bool(simplify(equal, 7).usable_rows().all())
