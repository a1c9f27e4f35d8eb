"""`ssim` and `photometric_loss`: closed forms, a loop, finite differences, native and reference."""

import functools
import math

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops.cuda import launches

from .scenes import REFERENCE, Variant, as_float32, assert_close, generator, one_line, uniform

SIZES = [(1, 1), (5, 3), (3, 5), (11, 11), (17, 23), (16, 16), (33, 64), (70, 41)]
# Near the tile sizes of a GPU: 32 columns, 24 rows of float or 12 of double.
TILES = [(11, 31), (12, 32), (13, 33), (23, 63), (24, 64), (25, 65), (1, 300), (300, 1)]
# More than 256 columns or 540 rows, the limits of a task on the CPU. On a GPU, the first size has
# more blocks than the kernel that adds their sums has threads.
STRIPS = [(3, 2800), (1100, 2), (541, 17)]
C1, C2 = 0.01**2, 0.03**2


def images(seed: int, height: int, width: int) -> tuple[Tensor, Tensor]:
    """A smooth image and a noisy, shifted version of it, (H, W, 3) planar, in [0, 1]."""
    g = generator(seed)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    waves = [torch.sin(0.3 * x + 0.2 * y + phase) for phase in (0.0, 1.0, 2.0)]
    smooth = 0.5 + 0.35 * torch.stack(waves).double()
    noisy = (smooth + uniform(g, -0.15, 0.15, 3, height, width)).clamp(0, 1)
    return as_float32(smooth).permute(1, 2, 0), as_float32(noisy.roll(1, dims=2)).permute(1, 2, 0)


def window() -> list[float]:
    weights = [math.exp(-((i - 5) ** 2) / (2 * 1.5**2)) for i in range(11)]
    return [w / sum(weights) for w in weights]


def ssim_slowly(a: Tensor, b: Tensor) -> float:
    """The definition, pixel by pixel: moments under the window, zeros outside of the image."""
    height, width, channels = a.shape
    w = window()
    first, second = a.tolist(), b.tolist()
    total = 0.0
    for channel in range(channels):
        for j in range(height):
            for i in range(width):
                moments = [0.0] * 5
                for dj in range(max(-5, -j), min(6, height - j)):
                    for di in range(max(-5, -i), min(6, width - i)):
                        weight = w[dj + 5] * w[di + 5]
                        p, q = first[j + dj][i + di][channel], second[j + dj][i + di][channel]
                        for k, value in enumerate((p, q, p * p, q * q, p * q)):
                            moments[k] += weight * value
                p, q, pp, qq, pq = moments
                luminance = (2 * p * q + C1) / (p * p + q * q + C1)
                structure = (2 * (pq - p * q) + C2) / (pp - p * p + qq - q * q + C2)
                total += luminance * structure
    return total / a.numel()


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_ssim_of_equal_images_is_one(variant: Variant, height: int, width: int) -> None:
    a = images(0, height, width)[0].to(variant.dtype)
    assert abs(float(variant.ops.ssim(a, a)) - 1) < 1e-6
    loss = variant.ops.photometric_loss(a.requires_grad_(), a.detach().clone())
    assert abs(float(loss.detach())) < 1e-6
    loss.backward()
    assert a.grad is not None
    assert a.grad.abs().max() < 1e-3 / a.numel()


def test_definition(variant: Variant) -> None:
    a, b = images(1, 7, 13)
    expected = ssim_slowly(a, b)
    assert float(variant.ops.ssim(a.to(variant.dtype), b.to(variant.dtype))) == pytest.approx(
        expected, rel=1e-5
    )


def test_loss_is_the_weighted_sum(variant: Variant) -> None:
    a, b = (i.to(variant.dtype) for i in images(2, 17, 23))
    l1, dssim = float((a - b).abs().mean()), 1 - float(variant.ops.ssim(a, b))
    for weight in (0.0, 0.2, 1.0):
        loss = variant.ops.photometric_loss(a, b, weight)
        assert loss.shape == ()
        assert float(loss) == pytest.approx((1 - weight) * l1 + weight * dssim, rel=1e-5)
    size = (a - b).abs()
    huber = float(torch.where(size < 0.1, size.square(), 0.1 * (2 * size - 0.1)).mean())
    loss = variant.ops.photometric_loss(a, b, 0.2, 10.0)
    assert float(loss) == pytest.approx(0.8 * l1 + 0.2 * dssim + 10.0 * huber, rel=1e-5)
    default = variant.ops.photometric_loss(a, b)
    assert float(default) == pytest.approx(0.8 * l1 + 0.2 * dssim, rel=1e-5)


def test_targets_with_8_bits(variant: Variant) -> None:
    a, b = images(3, 17, 23)
    a = a.to(variant.dtype).requires_grad_()
    levels = (b * 255).round().to(torch.uint8)
    as_bytes = variant.ops.photometric_loss(a, levels)
    as_bytes.backward()
    grad, a.grad = a.grad, None
    as_floats = variant.ops.photometric_loss(a, levels.to(variant.dtype) / 255)
    as_floats.backward()
    assert grad is not None
    assert a.grad is not None
    assert_close(as_bytes, as_floats, 1e-6)
    assert_close(grad, a.grad, 1e-5)
    similarities = [variant.ops.ssim(a, t) for t in (levels, levels.to(variant.dtype) / 255)]
    assert_close(similarities[0], similarities[1], 1e-6)


def test_storage_does_not_matter(variant: Variant) -> None:
    """Results for interleaved images (H, W, C) equal those for planar ones."""
    a, b = (i.to(variant.dtype) for i in images(4, 17, 23))
    assert not a.is_contiguous()
    planar = variant.ops.photometric_loss(a, b)
    interleaved = variant.ops.photometric_loss(a.contiguous(), b.contiguous())
    assert_close(interleaved, planar, 1e-6)


@pytest.mark.parametrize("weights", [(0.0, 0.0), (0.2, 0.0), (1.0, 0.0), (0.2, 10.0)])
def test_finite_differences(double: Variant, weights: tuple[float, float]) -> None:
    a, b = images(5, 3, 13)
    assert (a - b).abs().min() > 1e-5  # |a − b| has a kink where they are equal

    def loss(image: Tensor) -> Tensor:
        return double.ops.photometric_loss(image, b, *weights)

    assert torch.autograd.gradcheck(loss, (a.requires_grad_(),), eps=1e-6, atol=1e-8, rtol=1e-5)


def test_without_a_gradient(native: Variant) -> None:
    """The value is the same with and without a gradient, and in every run."""
    a, b = (i.to(native.dtype) for i in images(10, 40, 37))
    values = [native.ops.photometric_loss(image, b) for image in (a, a, a.clone().requires_grad_())]
    assert torch.equal(values[0], values[1])
    assert torch.equal(values[0], values[2].detach())


def test_channels_one_after_the_other(native: Variant, monkeypatch: pytest.MonkeyPatch) -> None:
    """For large images a GPU processes few channels at a time, with bit-identical results."""
    a, b = (i.to(native.dtype) for i in images(11, 27, 35))
    results = []
    for limit in (launches._MAPS_BYTES, 6 * 27 * 35 * a.element_size(), 0):
        monkeypatch.setattr(launches, "_MAPS_BYTES", limit)
        image = a.clone().requires_grad_()
        value = native.ops.photometric_loss(image, b)
        value.backward()
        assert image.grad is not None
        results.append((value.detach(), image.grad))
    for value, grad in results[1:]:
        assert torch.equal(value, results[0][0])
        assert torch.equal(grad, results[0][1])


def test_nan_affects_only_near_pixels(native: Variant) -> None:
    """The gradient of a pixel depends only on pixels at most 10 away."""
    a, b = images(12, 40, 50)
    a[20, 25, 1] = math.nan
    image = a.to(native.dtype).requires_grad_()
    value = native.ops.photometric_loss(image, b.to(native.dtype))
    value.backward()
    assert image.grad is not None
    assert value.isnan()
    finite = image.grad.isfinite()
    assert not finite[15:26, 20:31, 1].any()
    assert finite[:, :, 0].all()
    assert finite[:, :, 2].all()
    far = torch.ones(40, 50, dtype=torch.bool)
    far[10:31, 15:36] = False
    assert finite[:, :, 1][far].all()


def value_and_gradient(
    variant: Variant, name: str, height: int, width: int
) -> tuple[Tensor, Tensor]:
    a, b = images(height + width, height, width)
    image = a.to(variant.dtype, copy=True).requires_grad_()
    function = functools.partial(variant.ops.photometric_loss, huber_weight=10.0)
    function = function if name == "huber" else getattr(variant.ops, name)
    value = function(image, b.to(variant.dtype))
    assert value.dtype == variant.dtype
    (3 * value).backward()
    assert image.grad is not None
    return value.detach(), image.grad


@functools.cache
def expected(name: str, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Results of the reference, computed once for all variants."""
    return value_and_gradient(REFERENCE, name, height, width)


@pytest.mark.parametrize(("height", "width"), [*SIZES, *TILES, *STRIPS])
@pytest.mark.parametrize("name", ["ssim", "photometric_loss", "huber"])
def test_native_agrees_with_the_reference(
    native: Variant, name: str, height: int, width: int
) -> None:
    value, grad = value_and_gradient(native, name, height, width)
    expected_value, expected_grad = expected(name, height, width)
    assert_close(value, expected_value, native.forward, "value")
    assert_close(grad, expected_grad, native.backward, "gradient")


def test_native_agrees_with_the_reference_on_flat_images(native: Variant) -> None:
    """Without structure, the variances are differences of equal numbers, which are rounding errors.

    In float32 this is 1e-7 compared with C2 = 9e-4, so the tolerance is larger in this test.
    """
    a = as_float32(torch.full((20, 30, 3), 0.9, dtype=torch.float64))
    b = as_float32(torch.full((20, 30, 3), 0.85, dtype=torch.float64))
    values = [v.ops.ssim(a.to(v.dtype), b.to(v.dtype)) for v in (REFERENCE, native)]
    assert_close(values[1], values[0], 5 * native.forward)


WRONG = {
    "another size": (torch.zeros(5, 4, 3), torch.zeros(4, 5, 3)),
    "a batch": (torch.zeros(1, 5, 4, 3), torch.zeros(1, 5, 4, 3)),
    "another number of channels": (torch.zeros(5, 4, 3), torch.zeros(5, 4, 1)),
    "an empty image": (torch.zeros(0, 4, 3), torch.zeros(0, 4, 3)),
    "bytes as the image": (torch.zeros(5, 4, 3, dtype=torch.uint8), torch.zeros(5, 4, 3)),
    "half": (torch.zeros(5, 4, 3, dtype=torch.float16), torch.zeros(5, 4, 3)),
    "target of integers": (torch.zeros(5, 4, 3), torch.zeros(5, 4, 3, dtype=torch.int32)),
    "target of another precision": (torch.zeros(5, 4, 3), torch.zeros(5, 4, 3).double()),
    "target elsewhere": (torch.zeros(5, 4, 3), torch.zeros(5, 4, 3, device="meta")),
}


@pytest.mark.parametrize(("image", "target"), WRONG.values(), ids=WRONG.keys())
@pytest.mark.parametrize("name", ["ssim", "photometric_loss"])
def test_wrong_input(name: str, image: Tensor, target: Tensor) -> None:
    with pytest.raises(ValueError, match=name) as caught:
        getattr(ops, name)(image, target)
    assert one_line(caught.value)
