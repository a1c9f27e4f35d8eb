"""The native ops are bit-identical for any number of threads and in every run."""

import functools
import sys
from collections.abc import Iterator, Sequence

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import Capacity

from .scenes import (
    Scene,
    Variant,
    generator,
    leaf_splats,
    normal,
    random_scene,
    random_splats,
    uniform,
)

pytestmark = pytest.mark.isa

THREADS = (1, 2, 3, 7, 2)
COUNT, WIDTH, HEIGHT = 6000, 150, 90  # several blocks of rows, 60 tiles
DTYPES = [torch.float32, torch.float64]


@pytest.fixture(autouse=True)
def _threads_as_before() -> Iterator[None]:
    before = ops.get_num_threads()
    yield
    ops.set_num_threads(before)


def assert_same_bits(results: list[dict[str, Tensor]], threads: Sequence[int] = THREADS) -> None:
    for number, result in zip(threads[1:], results[1:], strict=True):
        for name, expected in results[0].items():
            # As bytes: equal NaNs are the same, and −0 is not 0.
            same = torch.equal(bits(result[name]), bits(expected))
            assert same, f"{name} with {number} threads is not what it is with one"


def bits(tensor: Tensor) -> Tensor:
    return tensor.detach().contiguous().flatten().view(torch.uint8)


@functools.cache
def the_scene() -> Scene:
    return random_scene(0, COUNT, WIDTH, HEIGHT)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_project(dtype: torch.dtype) -> None:
    results = []
    for threads in THREADS:
        ops.set_num_threads(threads)
        scene = the_scene().to(dtype)
        splats = scene.project(ops)
        assert splats.ids is not None
        splats.packed.backward(normal(generator(1), *splats.packed.shape).to(dtype))
        result = {name: leaf.grad for name, leaf in scene.leaves().items()}
        results.append({**result, "packed": splats.packed, "ids": splats.ids})
    assert_same_bits(results)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize(("channels", "count"), [(3, 3000), (5, 3000), (3, 12_000)])
def test_rasterize(dtype: torch.dtype, channels: int, count: int) -> None:
    made = random_splats(2, count, WIDTH, HEIGHT, channels, pixels=1.0)
    with_abs_grad = channels == 3
    cotangents = [normal(generator(4), HEIGHT, WIDTH, n).to(dtype) for n in (channels, 1, 1)]
    results = []
    for threads in THREADS:
        ops.set_num_threads(threads)
        splats = leaf_splats(made, dtype, with_abs_grad=with_abs_grad)
        background = uniform(generator(3), 0, 1, channels).to(dtype).requires_grad_()
        image, alpha, depth = ops.rasterize(splats, WIDTH, HEIGHT, background, with_depth=True)
        outputs = {"image": image, "alpha": alpha, "depth": depth}
        pairs = zip(outputs.values(), cotangents, strict=True)
        torch.autograd.backward(list(outputs.values()), [c.view_as(o) for o, c in pairs])
        grads = {"packed": splats.packed.grad, "background": background.grad}
        if splats.abs_grad is not None:
            grads["abs_grad"] = splats.abs_grad
        results.append({**outputs, **grads})
    assert_same_bits(results)


@pytest.mark.parametrize("channels", [3, 5])
@pytest.mark.parametrize(("count", "size", "pixels"), [(4000, 640, 12.0), (40_000, 16, 1.0)])
def test_rasterize_in_bands(channels: int, count: int, size: int, pixels: float) -> None:
    """One thread sums the gradients in several bands, or a tile is larger than a band; eight
    threads sum them in one band.
    """
    made = random_splats(5, count, size, size, channels, pixels=pixels)
    capacity = Capacity(sys.maxsize, torch.zeros(1, dtype=torch.int64))
    results = []
    for threads in (1, 8):
        ops.set_num_threads(threads)
        splats = leaf_splats(made, torch.float32, with_abs_grad=channels == 3)
        image, _, _ = ops.rasterize(splats, size, size, capacity=capacity)
        image.square().sum().backward()
        grads = {"packed": splats.packed.grad}
        if splats.abs_grad is not None:
            grads["abs_grad"] = splats.abs_grad
        results.append(grads)
    assert 32_768 < int(capacity.required) < 8 * 32_768
    assert_same_bits(results, (1, 8))


@pytest.mark.usefixtures("sums_in_order")
@pytest.mark.parametrize("channels", [3, 5])
def test_rasterize_with_sums_in_order(native: Variant, channels: int) -> None:
    """Gradients are summed in a fixed order, also on a GPU, if torch's setting requests it."""
    made = random_splats(2, 400, 60, 45, channels)
    results = []
    for _ in range(3):
        splats = leaf_splats(made, native.dtype, with_abs_grad=channels == 3)
        background = uniform(generator(3), 0, 1, channels).to(native.dtype).requires_grad_()
        image, alpha, _ = native.ops.rasterize(splats, 60, 45, background)
        (image.square().sum() + alpha.sum()).backward()
        grads = {"packed": splats.packed.grad, "background": background.grad}
        if splats.abs_grad is not None:
            grads["abs_grad"] = splats.abs_grad
        results.append({"image": image, "alpha": alpha, **grads})
    for result in results[1:]:
        for name, expected in results[0].items():
            assert torch.equal(bits(result[name]), bits(expected)), name


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_photometric_loss(dtype: torch.dtype) -> None:
    results = []
    target = uniform(generator(1), 0, 1, HEIGHT, WIDTH, 3).to(dtype)
    for threads in THREADS:
        ops.set_num_threads(threads)
        image = uniform(generator(0), 0, 1, HEIGHT, WIDTH, 3).to(dtype).requires_grad_()
        loss = ops.photometric_loss(image, target)
        loss.backward()
        results.append({"loss": loss, "gradient": image.grad, "ssim": ops.ssim(image, target)})
    assert_same_bits(results)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_neighbours(dtype: torch.dtype) -> None:
    points = normal(generator(0), 5000, 3).to(dtype)
    results = []
    for threads in THREADS:
        ops.set_num_threads(threads)
        results.append({"distances": ops.neighbours(points)})
    assert_same_bits(results)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_plane_sweep(dtype: torch.dtype) -> None:
    """Several tiles; at some planes, parts of the sources are outside."""
    g = generator(2)
    image, sources = uniform(g, 0, 1, HEIGHT, 300), uniform(g, 0, 1, 3, HEIGHT, 300)
    matrix = torch.eye(3, 4).repeat(3, 1, 1)
    matrix[:, :2, 3] = 20 * normal(g, 3, 2)
    tensors = [tensor.to(dtype) for tensor in (image, sources, matrix)]
    results = []
    for threads in THREADS:
        ops.set_num_threads(threads)
        depth, score = ops.plane_sweep(*tensors, 0.0, 1.0, planes=5)
        results.append({"inverse depth": depth, "score": score})
    assert_same_bits(results)
