"""`add_noise`: its random numbers, known values, the reference, extreme rows, wrong input."""

import math
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import reference

from .scenes import Variant, as_float32, assert_close, generator, normal, one_line

#: Those of MCMC density control.
OPTIONS = {"sharpness": 100.0, "opacity": 0.005, "negligible": 1e-4, "seed": 2**61 + 12345}


def rows(count: int, dtype: torch.dtype = torch.float64) -> SimpleNamespace:
    """Gaussians with all kinds of opacities: from those without noise to those with full noise."""
    g = generator(count)
    tensors = {
        "means": normal(g, count, 3),
        "log_scales": as_float32(normal(g, count, 3) - 1.0),
        "quats": normal(g, count, 4),
        "opacity_logits": as_float32(2.0 * normal(g, count) - 4.0),
    }
    return SimpleNamespace(**{name: tensor.to(dtype) for name, tensor in tensors.items()})


def copy(gaussians: SimpleNamespace) -> SimpleNamespace:
    return SimpleNamespace(**{name: tensor.clone() for name, tensor in vars(gaussians).items()})


def noise(variant: Variant, gaussians: SimpleNamespace, amount: float, **options: object) -> Tensor:
    """The difference of the means."""
    moved = copy(gaussians)
    variant.ops.add_noise(moved, amount, **{**OPTIONS, **options})
    return moved.means - gaussians.means


def test_random_bits_are_those_of_philox() -> None:
    """The known answers of Salmon et al. that have two counters of 0."""
    found = reference.random_bits(0, torch.tensor([0]))
    assert [f"{each:08x}" for each in found[0].tolist()] == [
        *("6627e8d5", "e169c58d", "bc57ac4c", "9b00dbd8")
    ]


def test_numbers_are_normal_and_independent() -> None:
    numbers = reference.normal_numbers(7, 0, 100_000)
    assert_close(numbers.T @ numbers / len(numbers), torch.eye(3).double(), 0.01)
    assert float(numbers.mean(0).abs().max()) < 0.01
    assert float((numbers**4).mean()) == pytest.approx(3.0, rel=0.03)
    other = reference.normal_numbers(8, 0, 100_000)
    for pair in (numbers[1:] * numbers[:-1], numbers * other):
        assert float(pair.mean(0).abs().max()) < 0.01


@pytest.mark.parametrize("count", [0, 1, 129, 5000])
@pytest.mark.parametrize("first", [0, 2**33 + 5])
def test_kernels_match_the_reference(native: Variant, count: int, first: int) -> None:
    given = rows(count)
    given.means *= 0.0  # so that the difference has no rounding error
    expected = noise(SimpleNamespace(ops=reference), given, 1.0, first=first)
    found = noise(
        native,
        SimpleNamespace(**{n: t.to(native.dtype) for n, t in vars(given).items()}),
        1.0,
        first=first,
    )
    assert_close(found, expected, native.forward)
    if count > 100:
        still = (found == 0).all(1)
        assert 0.1 < float(still.double().mean()) < 0.9


def test_a_known_row(variant: Variant) -> None:
    """Turned by 90° about z, the noise along the first axis of the Gaussian is along y."""
    half = math.sqrt(0.5)
    one = SimpleNamespace(
        means=torch.tensor([[1.0, 2.0, 3.0]], dtype=variant.dtype),
        log_scales=torch.tensor([[0.0, -50.0, -50.0]], dtype=variant.dtype),
        quats=torch.tensor([[half, 0.0, 0.0, half]], dtype=variant.dtype),
        opacity_logits=torch.tensor([-100.0], dtype=variant.dtype),
    )
    eta = reference.normal_numbers(OPTIONS["seed"], 0, 1)[0, 1]
    gate = 1 / (1 + math.exp(-0.5))
    moved = noise(variant, one, 0.25)[0]
    assert_close(moved, torch.tensor([0.0, 0.25 * gate * float(eta), 0.0]), 1e-5)


def test_numbers_depend_on_the_seed_and_the_row_alone(variant: Variant) -> None:
    """So two processes with a part of the rows each have the same result as one with all."""
    given = rows(300, variant.dtype)
    whole = noise(variant, given, 0.5)
    parts = [
        noise(
            variant,
            SimpleNamespace(**{name: t[part].clone() for name, t in vars(given).items()}),
            0.5,
            first=part.start,
        )
        for part in (slice(0, 130), slice(130, 300))
    ]
    assert torch.equal(torch.cat(parts), whole)
    other = noise(variant, given, 0.5, seed=5)
    assert (other != whole)[whole.any(1)].all(1).all()


@pytest.mark.parametrize("opacity", [0.5, 100.0])
def test_opaque_rows_are_unchanged(variant: Variant, opacity: float) -> None:
    given = rows(200, variant.dtype)
    given.opacity_logits[:] = opacity
    assert not noise(variant, given, 1e9).any()


def test_extreme_rows(native: Variant) -> None:
    """Finite rows stay finite, and a row that is not finite does not change the others."""
    given = rows(100, native.dtype)
    given.opacity_logits[:] = -9.0
    given.log_scales[0] = 300.0  # the variance is limited
    given.log_scales[1] = -300.0
    given.quats[2] = 0.0
    given.quats[3] = 1e-30
    given.quats[4] = 1e15
    given.opacity_logits[5] = -math.inf
    given.means[6] = 1e30
    plain = noise(native, given, 0.5)
    assert plain.isfinite().all()
    identity = rows(100, native.dtype)
    vars(identity).update({name: tensor.clone() for name, tensor in vars(given).items()})
    identity.quats[2:4] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    assert torch.equal(noise(native, identity, 0.5)[2:4], plain[2:4])
    assert float(plain[0].norm()) > 1e16

    bad = copy(given)
    bad.log_scales[10, 0] = math.nan
    bad.quats[11, 1] = math.nan
    bad.quats[12, 1] = math.inf
    bad.opacity_logits[13] = math.nan
    bad.log_scales[14] = math.inf
    moved = noise(native, bad, 0.5)
    assert not moved[10:14].any()
    assert moved.isfinite().all()
    others = [i for i in range(100) if not 10 <= i <= 14]
    assert torch.equal(moved[others], plain[others])
    assert not noise(native, given, math.inf).nan_to_num(posinf=1.0, neginf=1.0).any()


@pytest.mark.isa
def test_the_number_of_threads_does_not_change_a_bit() -> None:
    given, before, found = rows(20_000, torch.float32), ops.get_num_threads(), []
    for threads in (1, 3):
        ops.set_num_threads(threads)
        found.append(noise(SimpleNamespace(ops=ops), given, 0.5))
    ops.set_num_threads(before)
    assert torch.equal(*found)


def test_wrong_input() -> None:
    good = rows(4, torch.float32)
    wrong = {
        "means must be float32 or float64": {"means": good.means.half()},
        r"means must be \(any, 3\)": {"means": good.means[:, :2]},
        "log_scales must be": {"log_scales": good.log_scales[:3]},
        "quats must be": {"quats": good.quats.double()},
        "opacity_logits must be": {"opacity_logits": good.quats},
    }
    for message, tensors in wrong.items():
        with pytest.raises(ValueError, match=message) as caught:
            ops.add_noise(SimpleNamespace(**{**vars(good), **tensors}), 1.0, **OPTIONS)
        assert one_line(caught.value)
