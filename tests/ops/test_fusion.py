"""`fuse_depth`: known distances, and native against the reference."""

import math

import pytest
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import reference

from .scenes import Variant, generator, normal, one_line, uniform

#: A camera at the origin, focal length 4, of 8×6 pixels.
_TO_IMAGE = torch.tensor([[4.0, 0, 4, 0], [0, 4, 3, 0], [0, 0, 1, 0]])


def fused(variant: Variant, points: Tensor, depth: Tensor, image: Tensor | None = None) -> Tensor:
    """The sums of single points (N, 3), with the weight 2 and the truncation 0.5."""
    like = {"dtype": variant.dtype}
    channels = 0 if image is None else len(image)
    sums = torch.zeros(len(points), 1, 1, 1, 2 + channels, **like)
    weight = torch.full_like(depth, 2.0, **like)
    image = None if image is None else image.to(**like)
    maps = _TO_IMAGE.to(**like), depth.to(**like), weight, 0.5, image
    variant.ops.fuse_depth(sums, points.to(**like), 0.0, *maps)
    return sums[:, 0, 0, 0]


def test_distances_to_a_plane(variant: Variant) -> None:
    z = torch.tensor([1.0, 1.4, 1.75, 2.0, 2.25, 2.5, 3.0, -1.0])
    points = torch.stack([0 * z, 0 * z, z], 1)
    sums = fused(variant, points, torch.full((6, 8), 2.0))
    expected = [(2, 2), (2, 2), (2, 1), (2, 0), (1, -0.5), (0, 0), (0, 0), (0, 0)]
    torch.testing.assert_close(sums, torch.tensor(expected, dtype=variant.dtype), atol=1e-5, rtol=0)


def test_unknown_and_free_pixels_and_points_outside(variant: Variant) -> None:
    points = torch.tensor([[0.0, 0, 1], [2, 0, 1], [0, -0.9, 1], [0, 0, -1]])
    nothing = fused(variant, points, torch.zeros(6, 8))
    assert not nothing.any()
    free = fused(variant, points, torch.full((6, 8), math.inf))
    assert free.tolist() == [[2.0, 2.0], [0, 0], [0, 0], [0, 0]]


def test_no_depth_between_two_objects(variant: Variant) -> None:
    """Between a pixel at 1 and one at 3 there is no surface at 2."""
    depth = torch.where(torch.arange(8) < 4, 1.0, 3.0).expand(6, 8)
    points = torch.tensor([[0.02, 0, 2.0], [-0.02, 0, 2.0]])
    assert fused(variant, points, depth).tolist() == [[2.0, 2.0], [0, 0]]


def test_colours_of_points_on_the_surface_only(variant: Variant) -> None:
    image = torch.stack([torch.arange(8.0).expand(6, 8), torch.ones(6, 8)])
    points = torch.tensor([[0.0, 0, 2], [0, 0, 1.2]])
    sums = fused(variant, points, torch.full((6, 8), 2.0), image)
    assert sums.tolist() == [[2.0, 0, 7.0, 2.0], [0] * 4]  # between the columns 3 and 4


def _random_view(seed: int, width: int, height: int) -> tuple[Tensor, ...]:
    """to_image, a depth map with edges, holes and sky, weights, and an image; float64."""
    random = generator(seed)
    rotation = torch.linalg.qr(normal(random, 3, 3)).Q.double()
    rotation[2] *= rotation.det().sign()
    pose = torch.cat([rotation, torch.tensor([[0.1], [-0.2], [3.0]]).double()], 1)
    k = torch.tensor([[60.0, 0, width / 2], [0, 62, height / 2], [0, 0, 1]]).double()
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    depth = 3 + 0.3 * torch.sin(x / 7) + 0.5 * (y > height / 2)
    depth[: height // 8], depth[:, : width // 9] = math.inf, 0.0
    weight = uniform(random, 0.2, 1, height, width).double()
    weight[height // 3] = 0.0
    return k @ pose, depth.double(), weight, uniform(random, 0, 1, 3, height, width).double()


@pytest.mark.parametrize(("side", "cubes", "coloured"), [(8, 60, False), (1, 900, True)])
def test_native_agrees_with_the_reference(
    native: Variant, side: int, cubes: int, coloured: bool
) -> None:
    origins = 0.8 * normal(generator(side), cubes, 3).double()

    def run(of: object, dtype: torch.dtype) -> Tensor:
        sums = torch.zeros(cubes, side, side, side, 5 if coloured else 2, dtype=dtype)
        for seed in range(3):
            to_image, depth, weight, image = (t.to(dtype) for t in _random_view(seed, 64, 48))
            part = image if coloured else None
            maps = to_image, depth, weight, 0.4, part
            of.fuse_depth(sums, origins.to(dtype), 0.05, *maps)  # type: ignore[attr-defined]
        return sums

    expected = run(reference, torch.float64)
    assert (expected[..., 0] > 0).double().mean() > 0.1
    ops.set_num_threads(1)
    found = run(native.ops, native.dtype)
    # Rounding can move a sample into another pixel.
    close = torch.isclose(found.double(), expected, rtol=1e-3, atol=1e-3).all(-1)
    assert close.double().mean() > 0.995
    ops.set_num_threads(3)
    assert torch.equal(run(native.ops, native.dtype), found)


@pytest.mark.parametrize(("width", "height"), [(1, 9), (2, 2), (33, 17)])
def test_small_images(native: Variant, width: int, height: int) -> None:
    """In those that are one pixel wide, nothing is interpolated; 17 is more than a patch."""
    to_image, _, weight, image = _random_view(0, width, height)
    depth = torch.full((height, width), 3.0, dtype=torch.float64)
    origins = 0.8 * normal(generator(1), 200, 3).double()

    def run(of: object, dtype: torch.dtype) -> Tensor:
        sums = torch.zeros(200, 8, 8, 8, 5, dtype=dtype)
        maps = [t.to(dtype) for t in (to_image, depth, weight)]
        rows, colours = origins.to(dtype), image.to(dtype)
        of.fuse_depth(sums, rows, 0.05, *maps, 0.4, colours)  # type: ignore[attr-defined]
        return sums

    expected = run(reference, torch.float64)
    assert (expected[..., 0] > 0).any()
    close = torch.isclose(run(native.ops, native.dtype).double(), expected, rtol=1e-3, atol=1e-3)
    assert close.all(-1).double().mean() > 0.995


def test_wrong_input() -> None:
    sums, points, depth = torch.zeros(2, 1, 1, 1, 2), torch.zeros(2, 3), torch.ones(6, 8)
    wrong = {
        "sums": (sums[:1], points, depth, 1.0),
        "weight": (sums, points, depth[:5], 1.0),
        "truncation": (sums, points, depth, 0.0),
    }
    for message, (rows, origins, weight, truncation) in wrong.items():
        with pytest.raises(ValueError, match=message) as caught:
            ops.fuse_depth(rows, origins, 0.0, _TO_IMAGE, depth, weight, truncation)
        assert one_line(caught.value)
