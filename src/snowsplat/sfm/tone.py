"""A frame of a video as RGB of 8 bits: the right matrix, and HDR brought to what a screen shows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from av import VideoFrame

# Numbers of ITU-T H.273.
_PQ, _HLG = 16, 18
_UNSPECIFIED, _BT709, _BT2020 = 2, 1, 9
# Light that is shown as white: nominal diffuse white of BT.2408, in cd/m².
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
_KNEE = 0.7  # of white: below it light is shown as it is
_STEPS = 4096  # of the tables


def rgb_picture(frame: VideoFrame) -> np.ndarray:
    """(H, W, 3) uint8 of a decoded frame, as stored (not turned)."""
    matrix = None  # the frame's own
    if frame.colorspace == _UNSPECIFIED and frame.height >= 720:
        matrix = _BT709  # what players take for pictures of this size
    transfer = frame.color_trc
    if transfer not in (_PQ, _HLG):
        return frame.reformat(format="rgb24", src_colorspace=matrix).to_ndarray()
    if frame.colorspace == _UNSPECIFIED:
        matrix = _BT2020
    rgb48 = frame.reformat(format="rgb48le", src_colorspace=matrix)
    deep = rgb48.to_ndarray().astype(np.uint16, copy=False)
    # Row by row in bands, since floats of a whole 4K frame would take 100 MB.
    light = _LIGHT_OF_PQ if transfer == _PQ else _LIGHT_OF_HLG
    out = np.empty(deep.shape, np.uint8)
    for top in range(0, len(deep), 256):
        out[top : top + 256] = _shown(light[deep[top : top + 256] >> 4])
    return out


def _shown(light: np.ndarray) -> np.ndarray:
    """(…, 3) float32 linear BT.2020 in units of white, to sRGB 8 bits."""
    colours = np.clip(light @ _TO_709.T, 0, None)
    # What is brighter than the knee is bent below 1, by the brightest channel: that keeps hues.
    peak = np.maximum(colours.max(axis=-1, keepdims=True), 1e-6)
    room = 1 - _KNEE
    bent = _KNEE + room * (1 - np.exp((_KNEE - peak) / room))
    colours *= np.where(peak > _KNEE, bent / peak, 1)
    scaled = np.clip(colours, 0, 1) * (_STEPS - 1)
    return _SRGB[scaled.astype(np.int32)]


def _light_of_pq(signal: np.ndarray) -> np.ndarray:
    """SMPTE ST 2084, in units of white."""
    m1, m2 = 2610 / 16384, 2523 / 4096 * 128
    c1, c2, c3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    power = signal ** (1 / m2)
    return 10000 * (np.maximum(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1) / _WHITE


def _light_of_hlg(signal: np.ndarray) -> np.ndarray:
    """BT.2100, in units of white (a signal of 0.75); each channel gets the system's gamma of 1.2.

    That is meant for the luminance, but differs little, and one table does.
    """
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    return 1000 * scene**1.2 / _WHITE


def _srgb(light: np.ndarray) -> np.ndarray:
    curve = np.where(
        light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055
    )
    return np.rint(255 * curve).astype(np.uint8)


_SIGNALS = np.linspace(0, 1, _STEPS)
_LIGHT_OF_PQ = _light_of_pq(_SIGNALS).astype(np.float32)
_LIGHT_OF_HLG = _light_of_hlg(_SIGNALS).astype(np.float32)
_SRGB = _srgb(_SIGNALS)
