"""The formulas of docs/learn/rasterizer.md."""

import math
import struct

import numpy as np
import pytest
import torch

from snowsplat import ops
from snowsplat.ops import reference
from snowsplat.ops.splats import Splats2D
from snowsplat.util.native_layout import TILE

RANDOM = np.random.default_rng(0)


def ordered_bits(x: float) -> int:
    """The rule of the page: all bits of a negative number are inverted, otherwise the sign bit."""
    (bits,) = struct.unpack("<I", struct.pack("<f", x))
    return bits ^ 0xFFFFFFFF if bits >> 31 else bits | 0x80000000


def test_keys_preserve_the_order():
    numbers = np.sort(np.concatenate([RANDOM.normal(size=50), [0.0, 1e-30, -1e-30, 3e38]]))
    numbers = np.unique(numbers.astype(np.float32)).tolist()
    keys = [ordered_bits(x) for x in numbers]
    assert keys == sorted(keys)
    assert len(set(keys)) == len(keys)
    positive = [struct.unpack("<I", struct.pack("<f", x))[0] for x in numbers if x > 0]
    assert positive == sorted(positive)


def test_sorting_by_key_and_counting_sort_agree():
    """(tile · 2³² + depth bits) gives the order of a sort by depth and a stable sort by tile."""
    tiles, depths = RANDOM.integers(0, 5, 60), RANDOM.uniform(1, 4, 60).astype(np.float32)
    keys = [int(t) * 2**32 + ordered_bits(float(d)) for t, d in zip(tiles, depths, strict=True)]
    by_key = sorted(range(60), key=lambda i: keys[i])
    by_depth = np.argsort(depths, kind="stable")
    by_tile = by_depth[np.argsort(tiles[by_depth], kind="stable")]
    assert by_key == by_tile.tolist()


def test_the_bounding_box():
    """The largest x of the ellipse is k √Σ'xx; the code computes the same extent."""
    factor = RANDOM.normal(size=(2, 2))
    sigma, k = factor @ factor.T, 1.7
    angle = np.linspace(0, 2 * np.pi, 100_001)
    points = k * np.stack([np.cos(angle), np.sin(angle)], 1) @ factor.T
    assert points.max(axis=0) == pytest.approx(k * np.sqrt(sigma.diagonal()), rel=1e-6)
    opacity = math.exp(k * k / 2) / 255
    extent = reference._half_extents(
        torch.from_numpy(sigma.diagonal().copy())[None], torch.tensor([opacity]).double()
    )
    assert extent[0].numpy() == pytest.approx(k * np.sqrt(sigma.diagonal()))


def test_the_maximum_over_a_tile():
    """The maximum of α is at the centre if it is inside, otherwise on an edge that faces it."""
    for _ in range(20):
        factor = RANDOM.normal(size=(2, 2)) * 8
        K = np.linalg.inv(factor @ factor.T + np.eye(2))
        a, b, c = K[0, 0], K[0, 1], K[1, 1]
        low = RANDOM.uniform(-30, 10, 2)
        high = low + TILE - 1

        def exponent(x, y, a=a, b=b, c=c):
            return -0.5 * (a * x * x + c * y * y) - b * x * y

        grid = np.stack(
            np.meshgrid(*(np.linspace(u, v, 301) for u, v in zip(low, high, strict=True)))
        )
        sampled = exponent(*grid).max()
        y = np.clip(0, low[1], high[1])
        x = np.clip(0, low[0], high[0])
        on_row = exponent(np.clip(-b * y / a, low[0], high[0]), y)
        on_column = exponent(x, np.clip(-b * x / c, low[1], high[1]))
        found = max(on_row, on_column)
        assert found >= sampled - 1e-12
        assert found == pytest.approx(sampled, abs=2e-2)


def test_equal_depths_are_in_the_order_of_the_rows():
    splats = Splats2D.pack(
        torch.full((3, 2), 8.0),
        torch.tensor([[0.1, 0.0, 0.1]]).repeat(3, 1),
        torch.full((3,), 0.6),
        torch.full((3,), 2.0),
        torch.eye(3),
    )
    expected, _, _ = reference.rasterize(splats, 16, 16)
    found, _, _ = ops.rasterize(splats, 16, 16)
    assert torch.allclose(found, expected, atol=1e-5)
    assert expected[8, 8, 0] > expected[8, 8, 1] > expected[8, 8, 2]


def test_exercise_1():
    columns, rows = -(-1920 // TILE), -(-1080 // TILE)
    assert (columns, rows, columns * rows) == (120, 68, 8160)
    assert 2**12 < 8160 <= 2**13
