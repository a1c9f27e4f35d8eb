"""`plane_sweep`: known disparities, a slanted plane, and native against the reference."""

import functools
import math
from typing import Any

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import reference

from .scenes import Variant, as_float32, generator, normal, one_line, uniform


def shift_by(*baselines: float) -> Tensor:
    """Sources (S, 3, 4) at which a pixel of inverse depth w is moved by w · baseline to the right.

    The reference view and the sources have the same orientation and a focal length of one pixel.
    """
    matrix = torch.zeros(len(baselines), 3, 4, dtype=torch.float64)
    matrix[:, :, :3] = torch.eye(3)
    matrix[:, 0, 3] = torch.tensor(baselines)
    return matrix


def moved(image: Tensor, columns: int) -> Tensor:
    """Moves an image to the right; noise appears at the left."""
    noise = uniform(generator(99), 0, 1, *image.shape)
    return torch.cat([noise[:, :columns], image[:, : image.shape[1] - columns]], dim=1)


def sweep(variant: Variant, image: Tensor, sources: Tensor, matrix: Tensor, *args: Any, **kw: Any):
    """In the variant's dtype; the results in float64."""
    if kw.get("centre") is not None:
        kw["centre"] = kw["centre"].to(variant.dtype)
    tensors = (tensor.to(variant.dtype) for tensor in (image, sources, matrix))
    found = variant.ops.plane_sweep(*tensors, *args, **kw)
    assert all(result.dtype == variant.dtype for result in found)
    return tuple(result.double() for result in found)


# ------------------------------------------------------------------------------ known results


@pytest.mark.parametrize("radius", [1, 3])
def test_known_disparity(variant: Variant, radius: int) -> None:
    """Disparities 0 to 6 in steps of 0.5; both sources have the disparity 4."""
    image = uniform(generator(0), 0, 1, 18, 40)
    sources = torch.stack([moved(image, 4), moved(image, 4)])
    depth, score = sweep(
        variant, image, sources, shift_by(2, 2), 0.0, 3.0, planes=13, radius=radius
    )
    seen = slice(0, 40 - 4 - radius)  # the other windows leave the source
    assert (score[:, seen] - 1).abs().max() < 1e-5
    # The noise on both sides of the maximum is not symmetric, so the parabola moves it.
    assert (depth[:, seen] - 2).abs().max() <= 0.125
    assert (score[:, seen.stop :] < 0.99).all()


def test_parabola(variant: Variant) -> None:
    """A sine of disparity 3.8. Its period is the window, so scores are cosines of the phase."""
    x = torch.arange(60, dtype=torch.float64)
    image = (0.5 + 0.4 * torch.sin(2 * math.pi / 7 * x)).repeat(9, 1)
    source = (0.5 + 0.4 * torch.sin(2 * math.pi / 7 * (x - 3.8))).repeat(1, 9, 1)
    seen = slice(3, 60 - 3 - 5)
    scores = [math.cos(2 * math.pi / 7 * (disparity - 3.8)) for disparity in (3, 4, 5)]
    shift = 0.5 * (scores[0] - scores[2]) / (scores[0] - 2 * scores[1] + scores[2])
    depth, score = sweep(variant, image, source, shift_by(1), 3.0, 5.0, planes=3)
    assert (depth[:, seen] - (4 + shift)).abs().max() < 1e-5
    assert (score[:, seen] - scores[1]).abs().max() < 1e-5
    # The first and the last plane have one neighbour, and are not refined.
    for low in (3.0, 4.0):
        depth, _ = sweep(variant, image, source, shift_by(1), low, low + 1, planes=2)
        assert (depth[:, seen] == 4).all()


def test_gain_and_offset_do_not_matter(variant: Variant) -> None:
    image = uniform(generator(1), 0, 1, 12, 30)
    source = 0.25 * moved(image, 2) + 0.125
    _, score = sweep(variant, image, source[None], shift_by(1), 1.0, 3.0, planes=3)
    assert score[:, :25].min() > 0.9999
    depth, score = sweep(variant, image, 1 - source[None], shift_by(1), 2.0, 3.0, planes=2)
    assert (depth[:, :24] == 3).all()  # at plane 2 the correlation is -1


def test_the_two_best_sources_count(variant: Variant) -> None:
    """Two of five sources see the pixel, and three are noise. One source is to the right."""
    image = uniform(generator(2), 0, 1, 12, 30)
    noise = uniform(generator(3), 0, 1, 3, 12, 30)
    good = moved(image, 1)
    worse = 0.5 * good + 0.5 * noise[0]
    sources = torch.stack([noise[0], worse, noise[1], good, noise[2]])
    planes = {"planes": 2, "radius": 2}  # the disparities are 1 and 100
    _, score = sweep(variant, image, sources, shift_by(1, 1, 1, 1, 1), 1.0, 100.0, **planes)
    _, only = sweep(variant, image, worse[None], shift_by(1), 1.0, 100.0, **planes)
    seen = slice(0, 27)
    assert (score[:, seen] - 0.5 * (1 + only[:, seen])).abs().max() < 1e-5
    # If a single source sees the window, its correlation is the score.
    sources = torch.stack([noise[0], good])
    _, score = sweep(variant, image, sources, shift_by(1000, 1), 1.0, 100.0, **planes)
    assert (score[:, seen] - 1).abs().max() < 1e-5
    assert (score[:, 28:] == -1).all()


def test_windows_without_texture_have_no_result(variant: Variant) -> None:
    """The contrast of the left half is below one 8-bit level, and that of the right half above."""
    checks = (torch.arange(11)[:, None] + torch.arange(40)) % 2
    image = 0.3 + checks * torch.where(torch.arange(40) < 20, 1.8 / 255, 2.4 / 255).double()
    depth, score = sweep(variant, image, image[None], shift_by(1), 0.0, 1.0, planes=2)
    assert (score[:, :17] == -1).all()
    assert (depth[:, :17] == 0).all()
    assert (score[:, 23:] > 0.9).all()
    # A source without texture counts, but its correlation is low.
    _, score = sweep(variant, image, image[None] / 64, shift_by(1), 0.0, 1.0, planes=2)
    assert (score[:, 23:].abs() < 0.05).all()
    assert (score[:, 23:] > -1).all()


def test_windows_that_are_not_seen(variant: Variant) -> None:
    """One missing pixel of the image or of the source removes the windows that contain it."""
    image = uniform(generator(4), 0, 1, 15, 20)
    window = torch.zeros(15, 20, dtype=torch.bool)
    window[5:10, 6:11] = True
    for hole in (math.nan, math.inf):
        with_hole = image.clone()
        with_hole[7, 8] = hole
        _, score = sweep(variant, with_hole, image[None], shift_by(1), 0.0, 1.0, planes=2, radius=2)
        assert torch.equal(score == -1, window)
        # Bilinear interpolation reads the next pixel, even with the weight 0.
        _, score = sweep(variant, image, with_hole[None], shift_by(1), 0.0, 1e3, planes=2, radius=2)
        reads = torch.zeros(15, 20, dtype=torch.bool)
        reads[4:10, 5:11] = True
        assert torch.equal(score == -1, reads)
    behind = -shift_by(1)
    depth, score = sweep(variant, image, image[None], behind, 0.0, 1.0, planes=3)
    assert (score == -1).all()
    assert (depth == 0).all()


def test_centre(variant: Variant) -> None:
    """Every column has its own centre; the range is relative to it."""
    image = uniform(generator(5), 0, 1, 12, 40)
    source = moved(image, 3)[None]
    centre = 2.5 + 0.25 * (torch.arange(40) // 20).repeat(12, 1).double()
    depth, score = sweep(
        variant, image, source, shift_by(1), -0.5, 0.5, planes=5, radius=2, centre=centre
    )
    assert (depth[:, :17] - 3).abs().max() == 0  # the last plane
    assert (depth[:, 23:34] - 3).abs().max() <= 0.125  # the last but one
    assert score[:, 23:34].min() > 0.9999
    # Inverse depths below 0 do not count.
    depth, score = sweep(
        variant, image, moved(image, 0)[None], shift_by(-1), -2.0, -1.0, planes=2, centre=centre - 2
    )
    assert (score == -1).all()


# --------------------------------------------------------------------------- a slanted plane


def texture(points: Tensor) -> Tensor:
    """A smooth luminance on the plane, from world points (…, 3)."""
    x, y = points[..., 0], points[..., 1]
    waves = [
        torch.sin(6 * x + 2 * y),
        torch.sin(10 * y - 3 * x + 1),
        torch.sin(13 * x + 7 * y + 2),
        torch.sin(14 * y - 9 * x + 3),
    ]
    return 0.5 + 0.1 * torch.stack(waves).sum(dim=0)


@functools.cache
def slanted_plane() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Image, sources, source_from_pixel, and the true inverse depths.

    The cameras have different focal lengths, orientations and image sizes.
    """
    normal_of, distance = torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64), 3.0

    def intrinsics(width: int, height: int, focal: float) -> Tensor:
        return torch.tensor(
            [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=torch.float64
        )

    def photo(width: int, height: int, k: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        v, u = torch.meshgrid(
            torch.arange(height).double() + 0.5, torch.arange(width).double() + 0.5, indexing="ij"
        )
        rays = torch.stack([u, v, torch.ones_like(u)], dim=-1) @ torch.linalg.inv(k).T
        rotation, shift = pose[:, :3], pose[:, 3]
        position, directions = -shift @ rotation, rays @ rotation
        depth = (distance - position @ normal_of) / (directions @ normal_of)
        return texture(position + depth[..., None] * directions), 1 / depth

    k = intrinsics(64, 48, 60.0)
    image, inverse_depth = photo(64, 48, k, torch.eye(4, dtype=torch.float64)[:3])
    sources, matrices = [], []
    for i, (x, y, z) in enumerate([(-0.4, 0.05, 0.1), (0.35, -0.1, -0.1), (0.1, 0.4, 0.0)]):
        skew = torch.tensor([[0, 0.02 * i, -x], [-0.02 * i, 0, y], [x, -y, 0]]).double() / 4
        rotation = torch.matrix_exp(skew)
        pose = torch.cat([rotation, -rotation @ torch.tensor([[x], [y], [z]]).double()], dim=1)
        k_source = intrinsics(80, 56, 55.0 + 5 * i)
        sources.append(photo(80, 56, k_source, pose)[0])
        a = k_source @ pose[:, :3] @ torch.linalg.inv(k)
        matrices.append(torch.cat([a, k_source @ pose[:, 3:]], dim=1))
    return image, torch.stack(sources), torch.stack(matrices), inverse_depth


@pytest.mark.parametrize("count", [1, 3])
def test_slanted_plane(native: Variant, count: int) -> None:
    """Errors in units of the distance between planes, where at least one source sees the pixel."""
    image, sources, matrices, expected = slanted_plane()
    step = 0.0125
    views = image, sources[:count], matrices[:count]
    depth, score = sweep(native, *views, 0.2, 0.5, planes=25)
    found = score > 0.9
    assert found.double().mean() > (0.8 if count == 1 else 0.99)
    error = (depth - expected)[found].abs() / step
    assert error.median() < 0.1
    assert error.quantile(0.95) < 0.3
    # Centres near the true inverse depths: the planes of a window are as slanted as the surface.
    centre = 1.02 * expected
    depth, score = sweep(native, *views, -0.03, 0.03, planes=9, centre=centre)
    found = score > 0.9
    assert found.double().mean() > (0.8 if count == 1 else 0.99)
    error = (depth - expected)[found].abs() / step
    assert error.median() < (0.06 if count == 1 else 0.03)
    assert error.quantile(0.95) < 0.2


# ---------------------------------------------------------------------- against the reference


@functools.cache
def problem(
    height: int, width: int, count: int, source_height: int, source_width: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Noise, and homographies that leave the sources in some places."""
    g = generator(height + width + count)
    image = uniform(g, 0, 1, height, width)
    sources = uniform(g, 0, 1, count, source_height, source_width)
    units = torch.tensor([[1, 1, 10], [1, 1, 10], [1e-3, 1e-3, 1e-2]])
    a = torch.eye(3, dtype=torch.float64) + 0.02 * units * normal(g, count, 3, 3)
    a[:, 0] *= source_width / width
    a[:, 1] *= source_height / height
    b = torch.tensor([[0.2 * source_width], [0.1 * source_height], [0.1]]) * normal(g, count, 3, 1)
    return image, sources, as_float32(torch.cat([a, b], dim=2))


def assert_agrees(
    variant: Variant,
    found: tuple[Tensor, ...],
    expected: tuple[Tensor, ...],
    step: float,
) -> None:
    """Two planes may have almost equal scores, so in float32, a few depths may differ."""
    assert (found[1] - expected[1]).abs().max() < variant.forward
    error = (found[0] - expected[0]).abs() / step
    outliers = int((error > 10 * variant.forward).sum())
    assert outliers <= (1 + error.numel() // 1000 if variant.dtype == torch.float32 else 0)


def check(variant: Variant, size: tuple[int, ...], planes: int, radius: int, **kw: Any) -> Tensor:
    tensors = problem(*size)
    expected = reference.plane_sweep(*tensors, 0.1, 1.0, planes=planes, radius=radius, **kw)
    found = sweep(variant, *tensors, 0.1, 1.0, planes=planes, radius=radius, **kw)
    assert_agrees(variant, found, expected, 0.9 / (planes - 1))
    return expected[1]


@pytest.mark.parametrize("radius", range(1, 8))
def test_native_agrees_with_the_reference_for_any_radius(native: Variant, radius: int) -> None:
    score = check(native, (33, 41, 2, 60, 50), 5, radius)
    assert (score > -1).any()
    assert (score == -1).any()


@pytest.mark.parametrize("count", range(1, 9))
def test_native_agrees_with_the_reference_for_any_count(native: Variant, count: int) -> None:
    check(native, (17, 20, count, 18, 16), 4, 2)


# A tile of the CPU has at most 256×32 pixels, and one of a GPU 16×16.
SIZES = [
    (1, 1, 1, 2, 2),
    (1, 9, 2, 3, 12),
    (9, 1, 2, 12, 3),
    (5, 6, 3, 8, 7),
    (16, 16, 2, 16, 16),
    (31, 17, 2, 20, 40),
    (34, 258, 2, 50, 300),
    (70, 15, 2, 60, 33),
]


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("radius", [1, 4])
def test_native_agrees_with_the_reference_for_any_size(
    native: Variant, size: tuple[int, ...], radius: int
) -> None:
    check(native, size, 3, radius)


@pytest.mark.parametrize("planes", [2, 3, 40])
def test_native_agrees_with_the_reference_for_any_planes(native: Variant, planes: int) -> None:
    check(native, (20, 24, 3, 22, 30), planes, 2)


def test_native_agrees_with_the_reference_with_centres(native: Variant) -> None:
    size = (37, 45, 3, 40, 50)
    g = generator(7)
    centre = uniform(g, -0.4, 0.5, *size[:2])  # some of the planes are below 0
    centre[:20] = 0.25 * torch.linspace(0, 1, size[1]).double()
    centre[30, 20] = math.nan
    score = check(native, size, 6, 2, centre=as_float32(centre))
    assert (score == -1)[28:33, 18:23].all()
    assert (score > -1).float().mean() > 0.4


def test_low_contrast(native: Variant) -> None:
    """Luminances near 1 with a standard deviation of a few 8-bit levels."""
    image, sources, matrix = problem(20, 24, 3, 22, 30)
    image, sources = as_float32(0.95 + 0.05 * image), as_float32(0.95 + 0.05 * sources)
    expected = reference.plane_sweep(image, sources, matrix, 0.1, 1.0, planes=5)
    found = sweep(native, image, sources, matrix, 0.1, 1.0, planes=5)
    assert (found[1] - expected[1]).abs().max() < 10 * native.forward


# -------------------------------------------------------------------------------- wrong input

RIGHT = {
    "image": torch.rand(8, 9),
    "sources": torch.rand(2, 7, 6),
    "source_from_pixel": torch.rand(2, 3, 4),
    "min_inverse_depth": 0.0,
    "max_inverse_depth": 1.0,
}
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "colours": ({"image": torch.rand(8, 9, 3)}, "image must be"),
    "bytes": ({"image": torch.zeros(8, 9, dtype=torch.uint8)}, "image must be float32 or"),
    "no pixels": ({"image": torch.rand(0, 9)}, "at least 1×1"),
    "one source": ({"sources": torch.rand(7, 6)}, "sources must be"),
    "no sources": ({"sources": torch.rand(0, 7, 6)}, "1 to 8 sources, got 0"),
    "many sources": ({"sources": torch.rand(9, 7, 6)}, "1 to 8 sources, got 9"),
    "thin sources": ({"sources": torch.rand(2, 7, 1)}, "at least 2×2"),
    "large sources": (
        {"sources": torch.zeros(1).expand(2, 2**16, 2**15)},
        "fewer than 2³¹ pixels",
    ),
    "other dtype": ({"sources": torch.rand(2, 7, 6).double()}, "sources must be torch.float32"),
    "matrices": ({"source_from_pixel": torch.rand(3, 3, 4)}, "source_from_pixel must be"),
    "reversed": ({"min_inverse_depth": 1.5}, "0 ≤ min < max"),
    "equal": ({"min_inverse_depth": 1.0}, "0 ≤ min < max"),
    "negative": ({"min_inverse_depth": -0.1}, "0 ≤ min < max"),
    "NaN": ({"min_inverse_depth": math.nan}, "0 ≤ min < max"),
    "infinite": ({"max_inverse_depth": math.inf}, "0 ≤ min < max"),
    "one plane": ({"planes": 1}, "planes must be 2 or more"),
    "radius 0": ({"radius": 0}, "radius must be 1 to 7"),
    "radius 8": ({"radius": 8}, "radius must be 1 to 7"),
    "centre": ({"centre": torch.rand(9, 8)}, "centre must be"),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG.keys())
def test_wrong_input(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match="plane_sweep: .*" + message) as caught:
        ops.plane_sweep(**{**RIGHT, **change})
    assert one_line(caught.value)


@pytest.mark.isa
def test_tensors_need_not_be_contiguous() -> None:
    image, sources, matrix = (tensor.float() for tensor in problem(20, 24, 3, 22, 30))
    expected = ops.plane_sweep(image, sources, matrix, 0.1, 1.0)
    centre = torch.zeros(1).expand(20, 24)
    found = ops.plane_sweep(
        image.T.contiguous().T,
        sources.permute(2, 0, 1).contiguous().permute(1, 2, 0),
        matrix.mT.contiguous().mT,
        0.1,
        1.0,
        centre=centre,
    )
    assert all(map(torch.equal, found, expected))
