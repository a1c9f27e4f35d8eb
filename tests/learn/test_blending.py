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


def test_the_layers_are_the_integral():
    """C = ∫ T τ c ds for a density and a colour that are constant in intervals."""
    tau, delta, c = RANDOM.uniform(0, 2, 5), RANDOM.uniform(0.1, 0.5, 5), RANDOM.uniform(size=5)
    n = 40_000
    s = (np.arange(n) + 0.5) / n * delta.sum()
    interval = np.searchsorted(np.cumsum(delta), s)
    step = delta.sum() / n
    T = np.exp(-(np.cumsum(tau[interval]) - tau[interval] / 2) * step)
    integral = (T * tau[interval] * c[interval]).sum() * step
    assert nerf_weights(tau, delta) @ c == pytest.approx(integral, rel=1e-4)


def test_over_from_back_to_front_is_the_same():
    alphas, colors = RANDOM.uniform(0.05, 0.6, 6), RANDOM.uniform(size=(6, 3))
    background = np.array([0.2, 0.9, 0.4])
    result = background
    for alpha, color in zip(alphas[::-1], colors[::-1], strict=True):
        result = alpha * color + (1 - alpha) * result
    image, _, _ = reference.rasterize(
        splats_with(alphas, colors), 1, 1, torch.from_numpy(background)
    )
    assert image[0, 0].numpy() == pytest.approx(result)


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


def test_the_profile_of_a_cloud():
    """1 − exp(−κ G) has the maximum o for κ = −ln(1 − o), and is near o G for small κ."""
    g = np.linspace(0, 1, 11)
    for o in (0.5, 0.99):
        assert 1 - np.exp(math.log(1 - o) * 1.0) == pytest.approx(o)
    assert 1 - np.exp(-0.01 * g) == pytest.approx(0.01 * g, abs=1e-4)


def test_exercises():
    weights = np.array([0.5, 0.25, 0.125])
    image, _, _ = reference.rasterize(
        splats_with(np.full(3, 0.5), np.eye(3)), 1, 1, torch.ones(3).double()
    )
    assert image[0, 0].numpy() == pytest.approx(weights + 0.125)
    assert image[0, 0].tolist() == pytest.approx([0.625, 0.375, 0.25])
    many = splats_with(np.full(120, 0.1), np.ones((120, 3)))
    assert float(reference.count_blended(many, 1, 1)) == 87 == math.floor(math.log(1e-4, 0.9))
