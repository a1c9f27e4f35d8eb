"""How probable matches are under poses."""

import numpy as np
import pytest

from snowsplat.scene.epipolar import likelihood


def test_the_likelihood_of_one_match():
    """By hand: a distance of 0 with σ at its least, and ε at its least."""
    value, noise, false, count = likelihood(np.zeros(1), np.full(1, 1600.0))
    assert (noise, false) == (0.5, 0.01)
    assert value == pytest.approx(np.log(0.01 + 0.99 * np.sqrt(2 / np.pi) * 800 / 0.5))
    assert count == pytest.approx(1, abs=1e-4)
