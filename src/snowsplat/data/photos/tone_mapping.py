"""Tone mapping: from the signals of HDR, PQ and HLG, to sRGB; of films, HEIC and AVIF photos."""

from pathlib import Path

import numpy as np
from PIL import Image

from snowsplat.util.srgb import from_linear

#: Transfer characteristics, code points of ITU-T H.273: SMPTE ST 2084, and ARIB STD-B67.
PQ, HLG = 16, 18
# The luminance that is shown as white: nominal diffuse white of BT.2408, in cd/m².
_WHITE = 203.0
# Linear to BT.709, by the code point of the primaries: BT.2020 (BT.2087), Display P3.
_BT2020 = 9
_TO_709 = {
    _BT2020: ((1.6605, -0.5876, -0.0728), (-0.1246, 1.1329, -0.0083), (-0.0182, -0.1006, 1.1187)),
    12: ((1.2249, -0.2249, 0.0), (-0.0421, 1.0421, 0.0), (-0.0196, -0.0786, 1.0983)),
}
_KNEE = 0.7  # as a fraction of white: tone mapping does not change smaller values
_STEPS = 4096  # entries of the lookup tables
# Bytes at the start of a file in which its colours are described.
_HEAD = 1 << 16


def map_tones(signal: np.ndarray, transfer: int, primaries: int = _BT2020) -> np.ndarray:
    """(H, W, 3) uint8 sRGB from a signal (H, W, 3) of 16 bits; ``transfer``: `PQ` or `HLG`."""
    light = _LIGHT[transfer]
    out = np.empty(signal.shape, np.uint8)
    # In bands of rows, because a whole 4K frame in float32 takes 100 MB.
    for top in range(0, len(signal), 256):
        out[top : top + 256] = _map_light(light[signal[top : top + 256] >> 4], primaries)
    return out


def standard_range(image: Image.Image, path: Path) -> Image.Image:
    """A HEIC or AVIF photo of 8 bits per channel in sRGB, if its signal is PQ or HLG; otherwise the
    same object."""
    if image.format not in ("HEIF", "AVIF"):
        return image
    with open(path, "rb") as file:
        _, box, colours = file.read(_HEAD).partition(b"colrnclx")
    primaries, transfer = int.from_bytes(colours[:2], "big"), int.from_bytes(colours[2:4], "big")
    if not box or transfer not in _LIGHT:
        return image
    pixels = np.asarray(image.convert("RGB"), np.uint16) * 257
    mapped = Image.fromarray(map_tones(pixels, transfer, primaries))
    if "A" in image.getbands():
        mapped.putalpha(image.getchannel("A"))
    mapped.info = {key: value for key, value in image.info.items() if key != "icc_profile"}
    return mapped


def _map_light(light: np.ndarray, primaries: int) -> np.ndarray:
    """From (…, 3) float32 linear colours in units of white to (…, 3) uint8 sRGB."""
    matrix = np.array(_TO_709.get(primaries, np.eye(3)), np.float32)
    colours = np.clip(light @ matrix.T, 0, None)
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
_LIGHT = {
    PQ: _light_of_pq(_SIGNALS).astype(np.float32),
    HLG: _light_of_hlg(_SIGNALS).astype(np.float32),
}
_SRGB = np.rint(255 * from_linear(_SIGNALS)).astype(np.uint8)
