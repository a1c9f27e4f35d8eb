"""Codebooks: the properties of k-means."""

import numpy as np

from snowsplat.formats.codebooks import LEVELS, levels_for


def test_every_level_is_the_mean_of_its_values():
    """Every value also has the nearest level. Lloyd's iteration converges to this state."""
    random = np.random.default_rng(0)
    values = np.concatenate([random.normal(size=3000), random.normal(8, 0.1, 1000)])
    values = values.astype(np.float32)
    levels, index = levels_for(values)
    assert levels.shape == (LEVELS,)
    assert (np.diff(levels) >= 0).all()
    distances = np.abs(values[:, None].astype(np.float64) - levels)
    chosen = distances[np.arange(len(values)), index]
    np.testing.assert_allclose(chosen, distances.min(1), atol=1e-6)
    means = np.array([values[index == i].mean(dtype=np.float64) for i in np.unique(index)])
    off = np.abs(levels[np.unique(index)] - means)
    assert off.mean() < 2e-4
    # The error is not larger than with the best uniform levels.
    uniform = (values.max() - values.min()) / LEVELS / 12**0.5
    assert np.sqrt((chosen**2).mean()) < 0.5 * uniform


def test_few_values_are_exact_and_no_values_are_possible():
    values = np.float32([[3.0, -1.0], [3.0, 0.125]])
    levels, index = levels_for(values)
    assert index.shape == values.shape
    np.testing.assert_array_equal(levels[index], values)
    levels, index = levels_for(np.zeros((0, 3), np.float32))
    assert (levels.shape, index.shape) == ((LEVELS,), (0, 3))
