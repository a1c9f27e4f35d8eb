"""Converts video frames to 8-bit RGB, with the correct YUV matrix and tone mapping of HDR video."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from snowsplat.util.srgb import from_linear

if TYPE_CHECKING:
    from av import VideoFrame

# Code points of ITU-T H.273: transfer characteristics, then matrix coefficients.
_PQ = 16  # SMPTE ST 2084
_HLG = 18  # ARIB STD-B67
_BT709 = 1
_UNSPECIFIED = 2
_BT2020 = 9
# Rows of a frame from which on video players assume the matrix of BT.709, if none is declared.
_HD = 720
# The luminance that is shown as white: nominal diffuse white of BT.2408, in cd/m².
_WHITE = 203.0
# Linear BT.2020 to BT.709 (BT.2087).
_TO_709 = np.array(
    [
        [1.6605, -0.5876, -0.0728],
        [-0.1246, 1.1329, -0.0083],
        [-0.0182, -0.1006, 1.1187],
    ],
    np.float32,
)
_KNEE = 0.7  # as a fraction of white: tone mapping does not change smaller values
_STEPS = 4096  # entries of the lookup tables


def rgb_image(frame: VideoFrame) -> np.ndarray:
    """(H, W, 3) uint8 sRGB of a decoded frame, in the stored orientation."""
    matrix = None  # None: the matrix that the frame declares
    if frame.colorspace == _UNSPECIFIED and frame.height >= _HD:
        matrix = _BT709
    transfer = frame.color_trc
    if transfer not in (_PQ, _HLG):
        return frame.reformat(format="rgb24", src_colorspace=matrix).to_ndarray()
    if frame.colorspace == _UNSPECIFIED:
        matrix = _BT2020
    rgb48 = frame.reformat(format="rgb48le", src_colorspace=matrix)
    deep = rgb48.to_ndarray().astype(np.uint16, copy=False)
    # The frame is converted in bands of rows, because a whole 4K frame in float32 takes 100 MB.
    light = _LIGHT_OF_PQ if transfer == _PQ else _LIGHT_OF_HLG
    out = np.empty(deep.shape, np.uint8)
    for top in range(0, len(deep), 256):
        out[top : top + 256] = _map_tones(light[deep[top : top + 256] >> 4])
    return out


def _map_tones(light: np.ndarray) -> np.ndarray:
    """From (…, 3) float32 linear BT.2020 in units of white to (…, 3) uint8 sRGB."""
    colours = np.clip(light @ _TO_709.T, 0, None)
    # Pixels whose brightest channel is above the knee are compressed, so that it is below 1. The
    # three channels are multiplied by the same factor, which keeps the hue.
    peak = np.maximum(colours.max(axis=-1, keepdims=True), 1e-6)
    headroom = 1 - _KNEE
    bent = _KNEE + headroom * (1 - np.exp((_KNEE - peak) / headroom))
    colours *= np.where(peak > _KNEE, bent / peak, 1)
    scaled = np.clip(colours, 0, 1) * (_STEPS - 1)
    return _SRGB[scaled.astype(np.int32)]


def _light_of_pq(signal: np.ndarray) -> np.ndarray:
    """The luminance of a SMPTE ST 2084 signal (0..1), in units of `_WHITE`."""
    m1, m2 = 2610 / 16384, 2523 / 4096 * 128
    c1, c2, c3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    power = signal ** (1 / m2)
    return 10000 * (np.maximum(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1) / _WHITE


def _light_of_hlg(signal: np.ndarray) -> np.ndarray:
    """The luminance of a BT.2100 HLG signal (0..1), in units of `_WHITE`.

    A signal of 0.75 has the luminance `_WHITE`. The system gamma is 1.2. BT.2100 applies the gamma
    to the luminance. Here it is applied to each channel: the result differs little, and one lookup
    table is enough.
    """
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    return 1000 * scene**1.2 / _WHITE


_SIGNALS = np.linspace(0, 1, _STEPS)
_LIGHT_OF_PQ = _light_of_pq(_SIGNALS).astype(np.float32)
_LIGHT_OF_HLG = _light_of_hlg(_SIGNALS).astype(np.float32)
_SRGB = np.rint(255 * from_linear(_SIGNALS)).astype(np.uint8)
