"""The formulas of docs/learn/blending.md."""

import math

import numpy as np
import pytest
import torch

from snowsplat.ops import reference
from snowsplat.ops.splats import Splats2D

RANDOM = np.random.default_rng(0)


def nerf_weights(tau: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """The weights of NeRF (Mildenhall et al. 2020, eq. 3), from densities and lengths."""
    before = np.concatenate([[0.0], np.cumsum(tau * delta)[:-1]])
    return np.exp(-before) * (1 - np.exp(-tau * delta))


def splats_with(alphas: np.ndarray, colors: np.ndarray) -> Splats2D:
    """Splats whose centres are at the pixel centre (0.5, 0.5), so that α = o."""
    n = len(alphas)
    return Splats2D.pack(
        torch.full((n, 2), 0.5).double(),
        torch.tensor([[0.5, 0.0, 0.5]]).double().repeat(n, 1),
        torch.from_numpy(alphas),
        torch.arange(1, n + 1).double(),
        torch.from_numpy(colors),
    )


def test_the_weights_of_the_rasterizer_are_those_of_nerf():
    tau, delta = RANDOM.uniform(0, 2, 9), RANDOM.uniform(0.1, 0.5, 9)
    colors = RANDOM.uniform(size=(9, 3))
    alphas = 1 - np.exp(-tau * delta)
    weights = nerf_weights(tau, delta)
    image, alpha, depth = reference.rasterize(splats_with(alphas, colors), 1, 1, with_depth=True)
    assert image[0, 0].numpy() == pytest.approx(weights @ colors)
    assert float(alpha) == pytest.approx(weights.sum())
    assert float(alpha) == pytest.approx(1 - math.exp(-(tau * delta).sum()))  # 1 − T_{n+1}
    assert float(depth) == pytest.approx(weights @ np.arange(1, 10))


def test_the_limits():
    white = np.ones((1, 3))
    for opacity, expected in ((0.0039, 0.0), (0.004, 0.004), (1.0, 0.99)):
        image, _, _ = reference.rasterize(splats_with(np.array([opacity]), white), 1, 1)
        assert float(image[0, 0, 0]) == pytest.approx(expected)


def test_the_splat_that_would_end_the_pixel_is_left_out():
    """What remains can be nearly 1%, and the background gets it."""
    alphas = np.array([0.5, 0.981, 0.99, 0.2])  # T: 0.5, 0.0095, 0.000095
    image, _, _ = reference.rasterize(splats_with(alphas, np.ones((4, 3))), 1, 1)
    assert 1 - float(image[0, 0, 0]) == pytest.approx(0.0095)
