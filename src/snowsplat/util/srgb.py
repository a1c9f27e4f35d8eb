"""The curve of sRGB, between the values of a picture and linear light."""

import numpy as np


def to_linear(srgb: np.ndarray) -> np.ndarray:
    """sRGB, at least 0, as linear light."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def from_linear(light: np.ndarray) -> np.ndarray:
    """Linear light of any sign as sRGB; it is neither clipped nor rounded."""
    power = 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, power)
