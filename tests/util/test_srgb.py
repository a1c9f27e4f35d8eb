"""The curve of sRGB."""

import numpy as np
import pytest

from snowsplat.util.srgb import from_linear, to_linear


def test_colors_are_converted_to_linear_light_and_back():
    levels = np.linspace(0, 1, 1001)
    assert np.abs(from_linear(to_linear(levels)) - levels).max() < 1e-6
    assert to_linear(np.array(0.5)) == pytest.approx(0.2140, abs=1e-4)
