"""`rasterize`: closed forms, a per-pixel loop, finite differences, agreement of the engines."""

import functools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import reference, scratch
from snowsplat.ops.splats import Splats2D
from snowsplat.util.native_layout import SEGMENT

from .scenes import (
    EMULATED_LENGTH,
    REFERENCE,
    Variant,
    assert_close,
    differentiable_columns,
    generator,
    leaf_splats,
    normal,
    one_line,
    random_splats,
    smooth_scene,
    uniform,
)


def flat_stack(
    opacities: list[float], depths: list[float] | None = None, colors: Tensor | None = None
) -> Splats2D:
    """Splats so wide that α is the opacity in all pixels of a small image.

    The i-th splat has the i-th color of `colors`; by default, only channel i is not 0.
    """
    count = len(opacities)
    wide = 1e-9
    return Splats2D.pack(
        torch.full((count, 2), 2.0, dtype=torch.float64),
        torch.tensor([wide, 0, wide], dtype=torch.float64).expand(count, 3),
        torch.tensor(opacities, dtype=torch.float64),
        torch.tensor(depths or range(1, count + 1), dtype=torch.float64),
        torch.eye(count, dtype=torch.float64) if colors is None else colors,
    )


def blend_slowly(
    splats: Splats2D, width: int, height: int, background: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The definition, one pixel and one splat at a time."""
    means2d, conics, opacities, depths = (
        values.tolist()
        for values in (splats.means2d, splats.conics, splats.opacities, splats.depths)
    )
    rows = sorted(range(len(splats)), key=lambda row: (depths[row], row))
    colors, behind = splats.colors.tolist(), background.tolist()
    pixels = []
    for j in range(height):
        for i in range(width):
            T, z, color = 1.0, 0.0, [0.0] * splats.channels
            for row in rows:
                (x, y), (a, b, c) = means2d[row], conics[row]
                dx, dy = i + 0.5 - x, j + 0.5 - y
                falloff = math.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
                weight = opacities[row] * falloff
                if weight < 1 / 255:
                    continue
                weight = min(0.99, weight)
                if T * (1 - weight) < 1e-4:
                    break
                color = [sum_ + T * weight * c for sum_, c in zip(color, colors[row], strict=True)]
                z += T * weight * depths[row]
                T *= 1 - weight
            color = [sum_ + T * c for sum_, c in zip(color, behind, strict=True)]
            pixels.append([*color, 1 - T, z])
    planes = torch.tensor(pixels, dtype=torch.float64).reshape(height, width, -1)
    return planes[..., :-2], planes[..., -2], planes[..., -1]


BACKGROUND = torch.tensor([0.25, 0.5, 1.0], dtype=torch.float64)


@functools.cache
def blended_slowly(seed: int) -> tuple[Splats2D, tuple[Tensor, ...]]:
    """Splats and their image, computed once for all variants."""
    splats = random_splats(seed, 70, 19, 18, opacity=(0.3, 1.0))
    return splats, tuple(blend_slowly(splats, 19, 18, BACKGROUND))


@pytest.mark.parametrize("seed", [0, 1])
def test_definition(variant: Variant, seed: int) -> None:
    splats, wanted = blended_slowly(seed)
    background = BACKGROUND
    assert wanted[1].max() > 0.999  # some pixels stop early
    got = variant.ops.rasterize(
        leaf_splats(splats, variant.dtype), 19, 18, background.to(variant.dtype), with_depth=True
    )
    for actual, expected in zip(got, wanted, strict=True):
        assert actual is not None
        assert_close(actual, expected, max(variant.forward, 1e-7))


def test_shapes_and_storage(variant: Variant) -> None:
    splats = leaf_splats(random_splats(0, 9, 20, 13, channels=5), variant.dtype)
    image, alpha, depth = variant.ops.rasterize(splats, 20, 13)
    assert image.shape == (13, 20, 5)
    assert image.permute(2, 0, 1).is_contiguous()
    assert alpha.shape == (13, 20)
    assert depth is None
    assert image.dtype == alpha.dtype == variant.dtype


def test_opacity_is_clamped(variant: Variant) -> None:
    """α is clamped at 0.99, where opacity, conic and centre have no gradient."""
    splats = leaf_splats(flat_stack([1.0]), variant.dtype)
    image, alpha, _ = variant.ops.rasterize(splats, 3, 2)
    assert_close(alpha, torch.full((2, 3), 0.99), 1e-5)
    image.sum().backward()
    assert splats.packed.grad is not None
    assert splats.packed.grad[0, :8].abs().max() == 0
    assert_close(splats.packed.grad[0, 8], torch.tensor(6 * 0.99), 1e-5)


def test_opaque_stack_stops(variant: Variant) -> None:
    """T decreases to 0.2, …, 0.2⁵ = 3.2e-4; the sixth splat would make it 6.4e-5 and is skipped."""
    splats = leaf_splats(flat_stack([0.8] * 9), variant.dtype)
    image, alpha, depth = variant.ops.rasterize(splats, 3, 2, with_depth=True)
    weights = torch.tensor([0.8 * 0.2**i if i < 5 else 0.0 for i in range(9)])
    assert_close(image, weights.expand(2, 3, 9), 1e-5)
    assert_close(1 - alpha, torch.full((2, 3), 0.2**5), 1e-3)
    assert depth is not None
    (image.sum() + depth.sum() + alpha.sum()).backward()
    assert splats.packed.grad is not None
    assert (splats.packed.grad[:5].abs().sum(dim=1) > 0).all()
    assert (splats.packed.grad[5:] == 0).all()


def test_a_finished_pixel_stays_finished(variant: Variant) -> None:
    """A finished pixel blends no further splat, however transparent."""
    splats = leaf_splats(flat_stack([0.99, 0.95, 0.9, 0.01]), variant.dtype)
    image, _, _ = variant.ops.rasterize(splats, 1, 1)
    assert_close(image[0, 0], torch.tensor([0.99, 0.01 * 0.95, 0, 0]), 1e-5)


def test_faint_splats_are_skipped(variant: Variant) -> None:
    splats = leaf_splats(flat_stack([0.00391, 0.00393, 0.0]), variant.dtype)  # 1/255 = 0.003922
    image, _, _ = variant.ops.rasterize(splats, 1, 1)
    assert_close(image[0, 0], torch.tensor([0, 0.00393, 0]), 1e-5)


def test_equal_depths_blend_by_row(variant: Variant) -> None:
    splats = leaf_splats(flat_stack([0.5] * 4, [2.0, 1.0, 2.0, 1.0]), variant.dtype)
    image, _, _ = variant.ops.rasterize(splats, 1, 1)
    assert_close(image[0, 0], torch.tensor([0.125, 0.5, 0.0625, 0.25]), 1e-5)


@pytest.mark.parametrize("depth", [0.21, 1.5, 1000.0, 1e-3, 1e6])
def test_close_depths_blend_in_order(variant: Variant, depth: float) -> None:
    """Depths that differ by one float32 step are distinguished."""
    near = torch.tensor(depth)
    far = torch.nextafter(near, torch.tensor(math.inf))
    splats = leaf_splats(flat_stack([0.5, 0.5], [float(far), float(near)]), variant.dtype)
    image, _, _ = variant.ops.rasterize(splats, 1, 1)
    assert_close(image[0, 0], torch.tensor([0.25, 0.5]), 1e-5)


def test_no_splats(variant: Variant) -> None:
    splats = leaf_splats(random_splats(0, 0, 5, 4), variant.dtype)
    background = torch.tensor([0.25, 0.5, 1.0], dtype=variant.dtype, requires_grad=True)
    image, alpha, depth = variant.ops.rasterize(splats, 5, 4, background, with_depth=True)
    assert depth is not None
    assert torch.equal(image, background.expand(4, 5, 3))
    assert (alpha == 0).all()
    assert (depth == 0).all()
    image.sum().backward()
    assert background.grad is not None
    assert background.grad.tolist() == [20, 20, 20]


@pytest.mark.parametrize("additive", [False, True])
@pytest.mark.parametrize("with_depth", [False, True])
def test_finite_differences(double: Variant, with_depth: bool, additive: bool) -> None:
    """Every column and the background, for splats that are not near a threshold."""
    with torch.no_grad():
        splats = smooth_scene().project(reference)
    background = uniform(generator(4), 0, 1, 3).requires_grad_()
    columns = differentiable_columns(splats).requires_grad_()

    def outputs(columns: Tensor, background: Tensor) -> tuple[Tensor, ...]:
        made = Splats2D.pack(
            columns[:, 0:2], columns[:, 2:5], columns[:, 5], columns[:, 6], columns[:, 7:]
        )
        image, alpha, depth = double.ops.rasterize(
            made, 5, 4, background, with_depth=with_depth, additive=additive
        )
        outputs = (image, depth) if additive else (image, alpha, depth)
        return tuple(values for values in outputs if values is not None)

    check_gradients(double, outputs, (columns, background))


def check_gradients(
    double: Variant, outputs: Callable[..., Any], inputs: tuple[Tensor, ...]
) -> None:
    """By finite differences; with the slow emulation, only along a random direction."""
    fast = double.engine == "emulated"
    torch.manual_seed(0)
    assert torch.autograd.gradcheck(outputs, inputs, eps=1e-6, atol=1e-6, rtol=1e-6, fast_mode=fast)


def compare(
    native: Variant,
    splats: Splats2D,
    width: int,
    height: int,
    *,
    with_background: bool = True,
    with_depth: bool = True,
    additive: bool = False,
) -> None:
    """Values, and gradients of every column and the background, by random cotangents."""
    view = (width, height, with_background, with_depth, additive)
    key = (splats.packed.numpy().tobytes(), splats.channels, *view)
    if key not in _EXPECTED:
        _EXPECTED[key] = outputs_and_gradients(REFERENCE, splats, *view)
    wanted, wanted_grads = _EXPECTED[key]
    got, got_grads = outputs_and_gradients(native, splats, *view)
    for name, expected in wanted.items():
        assert_close(got[name], expected, native.forward, name)
    for name, expected in wanted_grads.items():
        assert_close(got_grads[name], expected, native.backward, f"gradient of {name}")
    assert (got_grads["radii and padding"] == 0).all()


#: Results of the reference, computed once for all variants.
_EXPECTED: dict[tuple, tuple[dict[str, Tensor], dict[str, Tensor]]] = {}


def outputs_and_gradients(
    variant: Variant,
    splats: Splats2D,
    width: int,
    height: int,
    with_background: bool,
    with_depth: bool,
    additive: bool,
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    g = generator(9)
    leaf, background = leaf_splats(splats, variant.dtype), None
    if with_background:
        background = uniform(g, 0, 1, splats.channels).to(variant.dtype).requires_grad_()
    cotangents = [normal(g, height, width, splats.channels), *normal(g, 2, height, width)]
    image, alpha, depth = variant.ops.rasterize(
        leaf, width, height, background, with_depth=with_depth, additive=additive
    )
    assert (depth is not None) == with_depth
    outputs = {"image": image, "alpha": alpha}
    if depth is not None:
        outputs["depth"] = depth
    pairs = zip(outputs.values(), cotangents, strict=False)
    sum((o * c.to(o)).sum() for o, c in pairs).backward()
    grads = columns_of(leaf)
    if background is not None:
        assert background.grad is not None
        grads["background"] = background.grad
    return {name: output.detach() for name, output in outputs.items()}, grads


def columns_of(leaf: Splats2D) -> dict[str, Tensor]:
    """The gradient of `packed`, by column."""
    assert leaf.packed.grad is not None
    grad = Splats2D(leaf.packed.grad, None, leaf.channels)
    rest = torch.cat([grad.packed[:, 7:8], grad.packed[:, 8 + leaf.channels :]], dim=1)
    names = ("means2d", "conics", "opacities", "depths", "colors")
    return {**{name: getattr(grad, name) for name in names}, "radii and padding": rest}


@pytest.mark.parametrize("with_background", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 4, 7, 8, 9, 30])
def test_native_agrees_with_the_reference(
    native: Variant, channels: int, with_background: bool
) -> None:
    splats = random_splats(channels, 60, 23, 17, channels)
    compare(native, splats, 23, 17, with_background=with_background)


@pytest.mark.parametrize(
    ("width", "height", "count"),
    [(1, 1, 5), (16, 16, 30), (17, 16, 30), (15, 33, 60), (64, 1, 20), (1, 50, 20), (83, 41, 400)],
)
def test_native_agrees_with_the_reference_at_any_size(
    native: Variant, width: int, height: int, count: int
) -> None:
    compare(native, random_splats(width + height, count, width, height), width, height)


def test_native_agrees_with_the_reference_on_a_long_strip(native: Variant) -> None:
    """Pixel coordinates of five digits, where float32 resolves a thousandth of a pixel.

    The reference draws four windows of the strip, with the splats moved by a multiple of a tile.
    """
    length = EMULATED_LENGTH if native.engine == "emulated" else 16384
    lefts, width = [0, 4096, 8192, (length - 160) // 16 * 16], 160
    packed = random_splats(4, 100, width, 3, pixels=30.0).packed
    for i, left in enumerate(lefts):
        packed[i::4, 0] += left
    cotangents = normal(generator(9), len(lefts), 5, 3, width)

    def drawn(variant: Variant, leaf: Tensor, left: int, width: int) -> Tensor:
        """(5, 3, width): image, alpha and depth of a part of the strip."""
        move = torch.zeros(leaf.shape[1], dtype=leaf.dtype)
        move[0] = left
        splats = Splats2D(leaf - move, None, 3)
        image, alpha, depth = variant.ops.rasterize(splats, width, 3, with_depth=True)
        return torch.cat([image.permute(2, 0, 1), alpha[None], depth[None]])

    exact = packed.clone().requires_grad_()
    leaf = packed.to(native.dtype).requires_grad_()
    whole = drawn(native, leaf, 0, length)
    parts = [whole[:, :, left : left + width] for left in lefts]
    wanted = [drawn(REFERENCE, exact, left, width) for left in lefts]
    for part, expected in zip(parts, wanted, strict=True):
        for rows, name in ((slice(3), "image"), (3, "alpha"), (4, "depth")):
            assert_close(part[rows], expected[rows], native.forward, name)
    for outputs in (parts, wanted):
        sum((o * c.to(o)).sum() for o, c in zip(outputs, cotangents, strict=True)).backward()
    grads = columns_of(Splats2D(leaf, None, 3))
    for name, expected in columns_of(Splats2D(exact, None, 3)).items():
        assert_close(grads[name], expected, native.backward, f"gradient of {name}")


@pytest.mark.parametrize("opacity", [(0.005, 0.02), (0.1, 0.4), (0.9, 1.0)])
def test_native_agrees_with_the_reference_when_splats_are_many(
    native: Variant, opacity: tuple[float, float]
) -> None:
    """Hundreds per tile: faint splats, all blended, and opaque ones, most of them skipped."""
    compare(native, random_splats(11, 500, 20, 18, pixels=5.0, opacity=opacity), 20, 18)


@pytest.fixture
def used_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """New memory has numbers, so that one that is read but never written has an effect.

    With NaN as the transmittance, a pixel would be finished.
    """
    take = scratch.empty

    def empty(*arguments: Any) -> Tensor:
        tensor = take(*arguments)
        return tensor.fill_(0.7) if tensor.is_floating_point() else tensor

    monkeypatch.setattr(scratch, "empty", empty)


@pytest.mark.usefixtures("used_memory")
@pytest.mark.parametrize("in_order", [False, True])
@pytest.mark.parametrize(("channels", "with_depth"), [(2, False), (3, True), (9, False)])
def test_tiles_of_several_segments(
    native: Variant, channels: int, with_depth: bool, in_order: bool, request: Any
) -> None:
    """A GPU cuts long tiles. Here there are tiles with one to four segments.

    In the fullest tile, most pixels are finished in the first segment, and some in no segment.
    """
    if in_order:
        request.getfixturevalue("sums_in_order")
    splats = random_splats(7, 1700, 40, 20, channels, pixels=3.0, opacity=(0.005, 0.03))
    x = splats.packed[:, 0]
    splats.packed[:, 0] = (40 * (x / 40).clamp(0, 1) ** 2).float()
    opaque = (splats.packed[:, :2] < 12).all(dim=1)
    splats.packed[opaque, 5] = 0.3
    compare(native, splats, 40, 20, with_depth=with_depth)


@pytest.mark.usefixtures("used_memory")
@pytest.mark.parametrize("in_order", [False, True])
@pytest.mark.parametrize("visited", [SEGMENT - 1, SEGMENT, SEGMENT + 1, 2 * SEGMENT, 600])
def test_a_tile_that_is_finished_at_the_end_of_a_segment(
    native: Variant, visited: int, in_order: bool, request: Any
) -> None:
    """The splats behind the finished pixels are in the same and in other segments."""
    if in_order:
        request.getfixturevalue("sums_in_order")
    opacities = [0.0055] * (visited - 3) + [0.95] * 3 + [0.5] * (SEGMENT + 10)
    splats = flat_stack(opacities, colors=uniform(generator(visited), -0.2, 1.0, len(opacities), 3))
    compare(native, splats, 19, 6)


@pytest.mark.usefixtures("used_memory")
@pytest.mark.parametrize("in_first", [0, SEGMENT - 1, SEGMENT, 2 * SEGMENT])
def test_a_tile_that_begins_at_the_end_of_a_segment(native: Variant, in_first: int) -> None:
    """Three tiles; the second is empty."""
    count = in_first + SEGMENT + 50
    splats = random_splats(3, count, 8, 8, pixels=0.5, opacity=(0.02, 0.03))
    splats.packed[:, :2] = splats.packed[:, :2].clamp(3, 5) + 4
    splats.packed[in_first:, 0] += 32
    compare(native, splats, 48, 16)


@pytest.mark.parametrize(
    "count", [0, 1, 7, 8, 9, 31, 32, 33, 64, 65, 255, 256, 257, 512, 513, 1000]
)
def test_native_agrees_with_the_reference_for_a_tile_of_any_length(
    native: Variant, count: int
) -> None:
    """As many splats as the kernels process together, one less, one more, none, and many."""
    splats = random_splats(count, count, 16, 16, pixels=4.0, opacity=(0.005, 0.03))
    compare(native, splats, 16, 16)


@pytest.mark.parametrize("faint", [0, 5, 31, 37, 250, 257])
def test_splats_behind_finished_pixels(native: Variant, faint: int) -> None:
    """The tile is finished after at most three splats of 0.95; the others have no gradient."""
    opacities = [0.01] * faint + [0.95] * 4 + [0.5] * 70
    colors = uniform(generator(faint), -0.2, 1.0, len(opacities), 3)
    splats = flat_stack(opacities, colors=colors)
    compare(native, splats, 19, 18)
    leaf = leaf_splats(splats, native.dtype)
    image, alpha, depth = native.ops.rasterize(leaf, 19, 18, with_depth=True)
    assert depth is not None
    (image.sum() + alpha.sum() + depth.sum()).backward()
    assert leaf.packed.grad is not None
    assert (leaf.packed.grad[faint + 3 :] == 0).all()
    assert (leaf.packed.grad[:faint, 8] != 0).all()


@pytest.mark.usefixtures("sums_in_order")
@pytest.mark.parametrize(("channels", "with_depth"), [(1, False), (3, False), (3, True), (9, True)])
def test_native_agrees_with_the_reference_with_sums_in_order(
    native: Variant, channels: int, with_depth: bool
) -> None:
    splats = random_splats(channels, 150, 35, 34, channels)
    compare(native, splats, 35, 34, with_depth=with_depth)


@pytest.mark.usefixtures("sums_in_order")
def test_native_agrees_with_the_reference_with_many_sums_in_order(native: Variant) -> None:
    """As many channels as splats; each tile is finished before the last of them."""
    compare(native, flat_stack([0.01] * 40 + [0.95] * 40), 19, 18)


@pytest.mark.parametrize("in_order", [False, True])
def test_capacity(native: Variant, in_order: bool, request: pytest.FixtureRequest) -> None:
    """A sufficient capacity has no effect; otherwise only some splats are drawn."""
    if in_order:
        request.getfixturevalue("sums_in_order")
    splats = random_splats(6, 200, 40, 33)

    def blended(capacity: ops.Capacity | None) -> list[Tensor]:
        leaf = leaf_splats(splats, native.dtype)
        image, alpha, depth = native.ops.rasterize(leaf, 40, 33, with_depth=True, capacity=capacity)
        (image.square().sum() + alpha.sum() + depth.sum()).backward()
        assert leaf.packed.grad is not None
        return [image, alpha, depth, leaf.packed.grad]

    ample = ops.Capacity(5000, torch.zeros(1, dtype=torch.int64))
    for got, expected in zip(blended(ample), blended(None), strict=True):
        assert_close(got, expected, native.forward)
    needed = int(ample.required)
    assert 200 < needed < 5000
    for instances in (needed, needed - 1, needed // 2, 1):
        cramped = ops.Capacity(instances, torch.zeros(1, dtype=torch.int64))
        assert all(tensor.isfinite().all() for tensor in blended(cramped))
        assert int(cramped.required) == needed


def test_native_agrees_with_the_reference_for_tiny_splats(native: Variant) -> None:
    """Splats smaller than a pixel, many between centres: none may be lost or counted twice."""
    compare(native, random_splats(12, 500, 40, 40, pixels=0.4), 40, 40)


def test_native_agrees_with_the_reference_for_needles(native: Variant) -> None:
    splats = random_splats(13, 40, 40, 40)
    angle = torch.arange(40, dtype=torch.float64) * math.pi / 40
    cos, sin, major, minor = angle.cos(), angle.sin(), 30.0, 0.55
    conics = [
        (cos / major) ** 2 + (sin / minor) ** 2,
        cos * sin * (major**-2 - minor**-2),
        (sin / major) ** 2 + (cos / minor) ** 2,
    ]
    splats.packed[:, 2:5] = torch.stack(conics, dim=1).float()
    compare(native, splats, 40, 40)


@pytest.mark.slow
def test_native_agrees_with_the_reference_for_thousands(native: Variant) -> None:
    """So many splats that they are sorted in parallel; some depths are equal."""
    count, width, height = 8500, 49, 34  # on the CPU, parallel from 8000 on
    splats = random_splats(14, count, width, height, pixels=0.4)
    splats.packed[::100, 6] = splats.packed[50, 6]
    assert len(splats.depths.unique()) < count
    compare(native, splats, width, height, with_depth=False)


@pytest.mark.parametrize("required", ["packed", "background"])
def test_only_requested_gradients_are_computed(native: Variant, required: str) -> None:
    splats = leaf_splats(random_splats(0, 20, 9, 9), native.dtype, requires_grad=False)
    background = torch.rand(3, generator=generator(0)).to(native.dtype)
    leaf = splats.packed if required == "packed" else background
    leaf.requires_grad_()
    native.ops.rasterize(splats, 9, 9, background)[0].square().sum().backward()
    assert leaf.grad is not None
    assert leaf.grad.norm() > 0


def test_backward_of_alpha_or_depth_alone(native: Variant) -> None:
    splats = random_splats(5, 30, 12, 12)
    for output in (0, 1, 2):
        grads = []
        for variant in (REFERENCE, native):
            leaf = leaf_splats(splats, variant.dtype)
            outputs = variant.ops.rasterize(leaf, 12, 12, with_depth=True)
            outputs[output].square().sum().backward()
            grads.append(leaf.packed.grad)
        assert_close(grads[1], grads[0], native.backward)


# Absolute gradients of the means


def backward_of(
    variant: Variant,
    splats: Splats2D,
    size: tuple[int, int],
    cotangents: Tensor,
    with_depth: bool = False,
    with_abs_grad: bool = True,
) -> Splats2D:
    """Leaf splats with the gradient of Σ cotangents (C or C + 1, H, W) · (image, depth)."""
    leaf = leaf_splats(splats, variant.dtype, with_abs_grad=with_abs_grad)
    image, _, depth = variant.ops.rasterize(leaf, *size, with_depth=with_depth)
    planes = image.permute(2, 0, 1)
    if depth is not None:
        planes = torch.cat([planes, depth[None]])
    (planes * cotangents.to(planes)).sum().backward()
    return leaf


@functools.cache
def absolute_by_definition(channels: int, with_depth: bool) -> tuple[Splats2D, Tensor, Tensor]:
    """Splats, cotangents and Σ |∂L/∂mean2d| (M, 2), with one backward pass per tile."""
    splats = random_splats(channels, 60, 37, 35, channels, pixels=5.0)
    cotangents = normal(generator(9), channels + with_depth, 35, 37)
    absolute = torch.zeros(len(splats), 2, dtype=torch.float64)
    for top in range(0, 35, 16):
        for left in range(0, 37, 16):
            of_tile = torch.zeros_like(cotangents)
            tile = (slice(None), slice(top, top + 16), slice(left, left + 16))
            of_tile[tile] = cotangents[tile]
            leaf = backward_of(REFERENCE, splats, (37, 35), of_tile, with_depth, False)
            assert leaf.packed.grad is not None
            absolute += leaf.packed.grad[:, :2].abs()
    return splats, cotangents, absolute


def check_abs_grad(variant: Variant, channels: int, with_depth: bool) -> None:
    splats, cotangents, absolute = absolute_by_definition(channels, with_depth)
    leaf = backward_of(variant, splats, (37, 35), cotangents, with_depth)
    assert leaf.abs_grad is not None
    assert leaf.packed.grad is not None
    assert_close(leaf.abs_grad, absolute, variant.backward)
    # Some splats are pulled in opposite directions; others touch one tile only.
    ratio = leaf.packed.grad[:, :2].abs() / leaf.abs_grad
    assert (ratio < 0.5).any()
    assert (ratio > 0.999).any()
    assert (leaf.packed.grad[:, 8 + channels :] == 0).all()


@pytest.mark.parametrize(("channels", "with_depth"), [(1, False), (3, False), (3, True)])
def test_abs_grad(variant: Variant, channels: int, with_depth: bool) -> None:
    check_abs_grad(variant, channels, with_depth)


@pytest.mark.usefixtures("sums_in_order")
@pytest.mark.parametrize(("channels", "with_depth"), [(1, False), (3, False), (3, True)])
def test_abs_grad_with_sums_in_order(native: Variant, channels: int, with_depth: bool) -> None:
    check_abs_grad(native, channels, with_depth)


@pytest.mark.usefixtures("sums_in_order")
def test_abs_grad_does_not_change_the_gradient(native: Variant) -> None:
    splats, cotangents, _ = absolute_by_definition(3, False)
    with_it, without = (
        backward_of(native, splats, (37, 35), cotangents, with_abs_grad=on).packed.grad
        for on in (True, False)
    )
    assert with_it is not None
    assert without is not None
    assert torch.equal(with_it, without)


def test_abs_grad_adds_up(variant: Variant) -> None:
    """Two images of the same splats, as for the gradient; invisible splats stay unchanged."""
    splats = random_splats(0, 30, 20, 18)
    splats.packed[::3, 5] = 0.001
    leaf = leaf_splats(splats, variant.dtype, with_abs_grad=True)
    assert leaf.abs_grad is not None
    leaf.abs_grad += 1
    for expected in (1, 2):
        image, _, _ = variant.ops.rasterize(leaf, 20, 18)
        image.square().sum().backward()
        if expected == 1:
            once = leaf.abs_grad - 1
    assert (once[1::3].sum(dim=1) > 0).any()
    assert_close(leaf.abs_grad, 1 + 2 * once, variant.backward)
    assert (leaf.abs_grad[::3] == 1).all()


WRONG = {
    "no width": {"width": 0},
    "negative height": {"height": -1},
    "background of another length": {"background": torch.zeros(4)},
    "background is an image": {"background": torch.zeros(3, 5, 5)},
    "background of another dtype": {"background": torch.zeros(3, dtype=torch.float64)},
    "background of integers": {"background": torch.zeros(3, dtype=torch.int32)},
    "background elsewhere": {"background": torch.zeros(3, device="meta")},
    "abs_grad of another length": {
        "splats": Splats2D(torch.zeros(2, 16), None, 3, torch.zeros(3, 2))
    },
    "abs_grad of another dtype": {
        "splats": Splats2D(torch.zeros(2, 16), None, 3, torch.zeros(2, 2).double())
    },
    "half": {"splats": Splats2D(torch.zeros(2, 16, dtype=torch.float16), None, 3)},
    "integers": {"splats": Splats2D(torch.zeros(2, 16, dtype=torch.int64), None, 3)},
}


@pytest.mark.parametrize("change", WRONG.values(), ids=WRONG.keys())
def test_wrong_input(change: dict) -> None:
    splats = leaf_splats(random_splats(0, 3, 5, 5), torch.float32)
    arguments = {"splats": splats, "width": 5, "height": 5, "background": None, **change}
    with pytest.raises(ValueError, match="rasterize") as caught:
        ops.rasterize(**arguments)
    assert one_line(caught.value)


def test_wrong_splats() -> None:
    with pytest.raises(ValueError, match="packed must be"):
        Splats2D(torch.zeros(3, 16), None, 9)
    with pytest.raises(ValueError, match="packed must be"):
        Splats2D(torch.zeros(16), None, 3)
    with pytest.raises(ValueError, match="channels"):
        Splats2D(torch.zeros(3, 16), None, 0)
    with pytest.raises(ValueError, match="ids must be int32"):
        Splats2D(torch.zeros(3, 16), torch.zeros(3, dtype=torch.int64), 3)
    with pytest.raises(ValueError, match="ids must be"):
        Splats2D(torch.zeros(3, 16), torch.zeros(2, dtype=torch.int32), 3)
    two, ones = torch.zeros(2, 2), torch.ones(2)
    with pytest.raises(ValueError, match="conics must be"):
        Splats2D.pack(two, torch.zeros(2, 4), ones, ones, torch.zeros(2, 3))
    with pytest.raises(ValueError, match="opacities must be"):
        Splats2D.pack(two, torch.zeros(2, 3), torch.ones(3), ones, torch.zeros(2, 3))
    with pytest.raises(ValueError, match="depths is"):
        Splats2D.pack(two, torch.zeros(2, 3), ones, ones.double(), torch.zeros(2, 3))


def test_pack_and_its_views() -> None:
    splats = random_splats(0, 6, 9, 9, channels=9)
    assert splats.packed.shape == (6, 32)
    again = Splats2D.pack(
        splats.means2d, splats.conics, splats.opacities, splats.depths, splats.colors
    )
    assert torch.equal(again.packed, splats.packed)
    a, b, c = splats.conics.unbind(dim=1)
    conic = torch.stack([a, b, b, c], dim=1).reshape(-1, 2, 2)
    major = torch.linalg.eigvalsh(torch.linalg.inv(conic))[:, 1]
    assert_close(splats.radii, 3 * major.sqrt(), 1e-9)


# Number of splats per pixel


@pytest.mark.parametrize(
    ("opacities", "expected"),
    # Each α = 0.5 leaves half: 13 of them leave 2⁻¹³ > 1e-4, one more would not. 0.003 < 1/255.
    [([0.5] * 20, 13), ([0.5] * 5, 5), ([0.003, 0.5], 1), ([0.003], 0), ([], 0)],
)
def test_count_of_a_stack(variant: Variant, opacities: list[float], expected: int) -> None:
    splats = leaf_splats(
        flat_stack(opacities, colors=torch.ones(len(opacities), 3).double()), variant.dtype
    )
    counts = variant.ops.count_blended(splats, 20, 18)
    assert counts.shape == (18, 20)
    assert bool((counts == expected).all())


def test_counts_match_the_reference(native: Variant) -> None:
    splats = random_splats(3, 300, 45, 37)
    exact = reference.count_blended(splats, 45, 37)
    assert float(exact.max()) > 5
    counts = native.ops.count_blended(leaf_splats(splats, native.dtype), 45, 37)
    # α next to 1/255 is rounded in float32.
    allowed = 0.01 if native.dtype == torch.float32 else 0.0
    assert float((counts.double() != exact).double().mean()) <= allowed


# The median


def test_median_of_a_stack(variant: Variant) -> None:
    """T in front of the layers is 1, 0.7, 0.42: the second one is at T = ½."""
    colors = torch.tensor([[1.0, 10], [2, 20], [3, 30]]).double()
    splats = leaf_splats(flat_stack([0.3, 0.4, 0.9], colors=colors), variant.dtype)
    median, mean, alpha = variant.ops.rasterize_median(splats, 20, 18)
    assert median.reshape(-1, 2).unique(dim=0).tolist() == [[2.0, 20.0]]
    assert_close(mean[3, 4], torch.tensor([0.3 + 0.56 + 1.134, 19.94]), 1e-4)
    assert_close(alpha, torch.full((18, 20), 1 - 0.7 * 0.6 * 0.1), 1e-4)


def test_median_matches_the_reference(native: Variant) -> None:
    splats = random_splats(3, 300, 45, 37)
    exact = reference.rasterize_median(splats, 45, 37)
    found = native.ops.rasterize_median(leaf_splats(splats, native.dtype), 45, 37)
    same = torch.isclose(found[0].double(), exact[0], atol=1e-5).all(2)
    assert float(same.double().mean()) > 0.99  # T next to 1/2 is rounded in float32
    assert_close(found[1].double(), exact[1], 1e-4)
    assert_close(found[2].double(), exact[2], 1e-4)


# Additive blending


def test_additive_definition(variant: Variant) -> None:
    """Each pixel is the background plus the sum of weight · colour; alpha is 0."""
    width, height = 21, 18
    splats = random_splats(2, 50, width, height, opacity=(0.3, 1.0))
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    image = BACKGROUND.expand(height, width, 3).clone()
    depth = torch.zeros(height, width, dtype=torch.float64)
    for mean, conic, o, z, color in zip(
        splats.means2d, splats.conics, splats.opacities, splats.depths, splats.colors, strict=True
    ):
        dx, dy = x + 0.5 - mean[0], y + 0.5 - mean[1]
        a, b, c = conic
        weight = o * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        weight[weight < 1 / 255] = 0
        image += weight[:, :, None] * color
        depth += weight * z
    got = variant.ops.rasterize(
        leaf_splats(splats, variant.dtype),
        *(width, height, BACKGROUND.to(variant.dtype)),
        with_depth=True,
        additive=True,
    )
    assert (got[1] == 0).all()
    assert got[2] is not None
    assert_close(got[0], image, max(variant.forward, 1e-7))
    assert_close(got[2], depth, max(variant.forward, 1e-7))


def test_additive_splats_are_not_limited(variant: Variant) -> None:
    """Opaque splats are added completely, also behind others, and have gradients."""
    splats = leaf_splats(flat_stack([1.0] * 5), variant.dtype)
    image, _, _ = variant.ops.rasterize(splats, 3, 2, additive=True)
    assert_close(image, torch.ones(2, 3, 5), 1e-5)
    image.sum().backward()
    assert splats.packed.grad is not None
    assert_close(splats.packed.grad[:, 5], torch.full((5,), 6.0), 1e-5)


@pytest.mark.parametrize(
    ("channels", "width", "height", "count"),
    [(1, 17, 16, 30), (3, 23, 17, 60), (4, 64, 1, 20), (9, 35, 34, 150), (3, 16, 16, 1000)],
)
def test_additive_native_agrees_with_the_reference(
    native: Variant, channels: int, width: int, height: int, count: int
) -> None:
    splats = random_splats(channels, count, width, height, channels)
    compare(native, splats, width, height, additive=True)


@pytest.mark.usefixtures("sums_in_order")
def test_additive_native_agrees_with_the_reference_with_sums_in_order(native: Variant) -> None:
    compare(native, random_splats(3, 150, 35, 34), 35, 34, additive=True)
