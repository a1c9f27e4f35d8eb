"""Converts video frames to 8-bit RGB, with the correct YUV matrix and tone mapping of HDR video."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from snowsplat.data.photos.tone_mapping import HLG, PQ, map_tones

if TYPE_CHECKING:
    from av import VideoFrame

# Matrix coefficients: code points of ITU-T H.273.
_BT709 = 1
_UNSPECIFIED = 2
_BT2020 = 9
# Rows of a frame from which on video players assume the matrix of BT.709, if none is declared.
_HD = 720


def rgb_image(frame: VideoFrame) -> np.ndarray:
    """(H, W, 3) uint8 sRGB of a decoded frame, in the stored orientation."""
    matrix = None  # None: the matrix that the frame declares
    if frame.colorspace == _UNSPECIFIED and frame.height >= _HD:
        matrix = _BT709
    transfer = frame.color_trc
    if transfer not in (PQ, HLG):
        return frame.reformat(format="rgb24", src_colorspace=matrix).to_ndarray()
    if frame.colorspace == _UNSPECIFIED:
        matrix = _BT2020
    rgb48 = frame.reformat(format="rgb48le", src_colorspace=matrix)
    deep = rgb48.to_ndarray().astype(np.uint16, copy=False)
    return map_tones(deep, transfer)
