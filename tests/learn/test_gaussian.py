"""The formulas of docs/learn/gaussian.md."""

import math

import numpy as np
import pytest
import torch

from snowsplat.ops import reference
from snowsplat.ops.reference import ALPHA_MIN

RANDOM = np.random.default_rng(0)


def covariance(n: int) -> np.ndarray:
    """A random positive definite matrix."""
    factor = RANDOM.normal(size=(n, n))
    return factor @ factor.T + 0.1 * np.eye(n)


def gaussian(x: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """exp(−½ xᵀ Σ⁻¹ x) for rows x."""
    return np.exp(-0.5 * np.einsum("...i,ij,...j->...", x, np.linalg.inv(sigma), x))


def test_the_cutoff_is_that_of_the_code():
    """α = o exp(−k²/2) = 1/255 at k = √(2 ln(255 o)), which gives the extent of a splat."""
    for opacity in (0.02, 0.3, 1.0):
        k = math.sqrt(2 * math.log(255 * opacity))
        assert opacity * math.exp(-k * k / 2) == pytest.approx(ALPHA_MIN)
        variances = torch.tensor([[4.0, 9.0]], dtype=torch.float64)
        extent = reference._half_extents(variances, torch.tensor([opacity], dtype=torch.float64))
        assert extent[0].tolist() == pytest.approx([2 * k, 3 * k])
    assert math.sqrt(2 * math.log(255)) == pytest.approx(3.329, abs=5e-4)


def test_the_exponent_is_that_of_the_code():
    sigma, opacity = covariance(2), 0.8
    K = np.linalg.inv(sigma)
    d = RANDOM.normal(size=(6, 2))
    conic = torch.tensor([[K[0, 0], K[0, 1], K[1, 1]]])
    pixels, mean = torch.from_numpy(d), torch.zeros(1, 2, dtype=torch.float64)
    alpha, _, _ = reference._blend_weights(pixels, mean, conic, torch.tensor([opacity]).double())
    expected = opacity * gaussian(d, sigma)
    assert alpha[:, 0].numpy() == pytest.approx(np.where(expected < 1 / 255, 0, expected))
