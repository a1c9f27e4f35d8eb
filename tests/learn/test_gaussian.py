"""The formulas of docs/learn/gaussian.md."""

import math

import numpy as np
import pytest
import torch

from snowsplat.ops import reference
from snowsplat.ops.reference import ALPHA_MIN, LOW_PASS

RANDOM = np.random.default_rng(0)


def covariance(n: int) -> np.ndarray:
    """A random positive definite matrix."""
    factor = RANDOM.normal(size=(n, n))
    return factor @ factor.T + 0.1 * np.eye(n)


def gaussian(x: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """exp(−½ xᵀ Σ⁻¹ x) for rows x."""
    return np.exp(-0.5 * np.einsum("...i,ij,...j->...", x, np.linalg.inv(sigma), x))


def test_the_integral_over_the_space():
    """∫ G = (2π)^(3/2) √det Σ, by a sum over a grid in the coordinates of the eigenvectors."""
    sigma = covariance(3)
    values, vectors = np.linalg.eigh(sigma)
    steps = np.linspace(-7, 7, 57)
    grid = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    volume = (steps[1] - steps[0]) ** 3 * math.sqrt(values.prod())
    total = gaussian(grid * np.sqrt(values) @ vectors.T, sigma).sum() * volume
    assert total == pytest.approx((2 * math.pi) ** 1.5 * math.sqrt(np.linalg.det(sigma)), rel=1e-6)


def test_level_sets_are_ellipsoids():
    """Points at k σ_i along the axes v_i, and on the ellipsoid between them, have exp(−k²/2)."""
    sigma = covariance(3)
    values, vectors = np.linalg.eigh(sigma)
    u = RANDOM.normal(size=(20, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    for k, expected in ((1, 0.607), (2, 0.135), (3, 0.0111), (3.329, 0.00392)):
        found = gaussian(k * u * np.sqrt(values) @ vectors.T, sigma)
        assert found == pytest.approx(np.full(20, math.exp(-k * k / 2)))
        assert found[0] == pytest.approx(expected, rel=5e-3)


def test_the_cutoff_is_that_of_the_code():
    """α = o exp(−k²/2) = 1/255 at k = √(2 ln(255 o)), which gives the extent of a splat."""
    for opacity in (0.02, 0.3, 1.0):
        k = math.sqrt(2 * math.log(255 * opacity))
        assert opacity * math.exp(-k * k / 2) == pytest.approx(ALPHA_MIN)
        variances = torch.tensor([[4.0, 9.0]], dtype=torch.float64)
        extent = reference._half_extents(variances, torch.tensor([opacity], dtype=torch.float64))
        assert extent[0].tolist() == pytest.approx([2 * k, 3 * k])
    assert math.sqrt(2 * math.log(255)) == pytest.approx(3.329, abs=5e-4)


def test_affine_maps():
    sigma, A, b, mean = covariance(3), RANDOM.normal(size=(3, 3)), RANDOM.normal(size=3), np.ones(3)
    x = RANDOM.normal(size=(10, 3))
    moved = gaussian((x @ A.T + b) - (A @ mean + b), A @ sigma @ A.T)
    assert moved == pytest.approx(gaussian(x - mean, sigma))


def test_the_integral_along_an_axis():
    """∫ G dz = √(2π/c) exp(−½ dᵀ S⁻¹ d): S is Σ without the row and the column of the axis."""
    sigma = covariance(3)
    inverse = np.linalg.inv(sigma)
    S, (A, b, c) = sigma[:2, :2], (inverse[:2, :2], inverse[:2, 2], inverse[2, 2])
    assert np.linalg.inv(S) == pytest.approx(A - np.outer(b, b) / c)
    z = np.linspace(-60, 60, 24001)
    for d in RANDOM.normal(size=(5, 2)):
        points = np.concatenate([np.tile(d, (len(z), 1)), z[:, None]], axis=1)
        total = gaussian(points, sigma).sum() * (z[1] - z[0])
        assert total == pytest.approx(math.sqrt(2 * math.pi / c) * gaussian(d, S), rel=1e-9)
        # Exercise 3: the section through the centre is narrower.
        assert d @ A @ d >= d @ np.linalg.inv(S) @ d


def test_the_exponent_is_that_of_the_code():
    sigma, opacity = covariance(2), 0.8
    K = np.linalg.inv(sigma)
    d = RANDOM.normal(size=(6, 2))
    conic = torch.tensor([[K[0, 0], K[0, 1], K[1, 1]]])
    pixels, mean = torch.from_numpy(d), torch.zeros(1, 2, dtype=torch.float64)
    alpha, _, _ = reference._blend_weights(pixels, mean, conic, torch.tensor([opacity]).double())
    expected = opacity * gaussian(d, sigma)
    assert alpha[:, 0].numpy() == pytest.approx(np.where(expected < 1 / 255, 0, expected))


def test_exercises():
    k = math.sqrt(2 * math.log(255 * 0.5))
    assert k == pytest.approx(3.114, abs=5e-4)
    assert [2 * k, k, 0.5 * k] == pytest.approx([6.23, 3.11, 1.56], abs=5e-3)
    # The product of two Gaussians: the inverse covariances are added.
    a, b = covariance(3), covariance(3)
    x = RANDOM.normal(size=(5, 3))
    both = np.linalg.inv(np.linalg.inv(a) + np.linalg.inv(b))
    assert gaussian(x, a) * gaussian(x, b) == pytest.approx(gaussian(x, both))
    assert LOW_PASS == 0.3  # the value that other pages name
