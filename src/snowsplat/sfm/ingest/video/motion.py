"""Motion in a video: whether the camera has moved, and how far the image content has moved.

All functions use small grey copies of frames, (H, W) uint8. `CONTENT_SIDE` and `SHARPNESS_SIDE` in
`content.sharpness` are the longest sides of these copies. A copy is divided into
blocks. The shift of each block is estimated by phase correlation. The motion is the median shift of
the blocks with texture. So neither a person who walks through the scene nor noise nor a change of
light counts as motion. A rotation or zoom of the camera does, because it shifts most blocks.
"""

import numpy as np
from PIL import Image

# Smallest shift of a moving camera, in pixels of a copy of `CONTENT_SIDE`: 0.6% of its longest
# side. Measured: 0 or 1 for a static camera, even with noise; 3 to 10 within 0.4 s for a camera
# that is carried while walking.
_MOVED = 2.0
_BLOCK = 32  # pixels: side of a block; phase correlation measures shifts up to half of this side
_MIN_CONTRAST = 3.0  # standard deviation of the grey levels of a block with texture

#: Longest side in pixels of the copies with which `FrameMotion` measures. With this size, blocks of
#: 32 pixels measure a shift of up to 12% of the frame, more than a fast pan has between two frames.
_MOTION_SIDE = 128
# In pixels of these copies: 4% of the frame. The shift is measured from a reference frame, which is
# replaced when the shift reaches this value. So the errors of rounding to pixels and the shake of a
# hand do not add up.
_NEW_REFERENCE = 5.0
# Two frames with less agreement (`_shift`) show different places. Measured: 0.13 to 0.21 for photos
# of different scenes; 0.4 to 1 for frames of a video (also blurred ones) with a shift of less than
# `_NEW_REFERENCE`.
_MIN_AGREEMENT = 0.25


def has_moved(before: np.ndarray, after: np.ndarray, fixed: np.ndarray | None = None) -> bool:
    """Whether the camera moved between two frames, given equally large copies of `CONTENT_SIDE`.

    ``fixed``: as for `FrameMotion`.
    """
    if min(before.shape) < _BLOCK:
        return bool(np.abs(before.astype(np.float32) - after).mean() >= 1.0)
    first, second = _blocks(before, fixed), _blocks(after, fixed)
    textured = _textured(first)
    if not textured.any():
        return bool(np.abs(first - second).mean() >= 1.0)
    return _shift(_spectrum(first[textured]), _spectrum(second[textured]))[0] >= _MOVED


class FrameMotion:
    """How far the image content has moved since the first frame of a video.

    The motion is the sum of small shifts, whatever their direction. Motion blur hardly affects it,
    because blur hardly changes the phases of a small copy. A cut counts as a shift by about an
    eighth of the frame, and so do other changes that are too large to be measured.

    ``fixed``: (H, W) bool, pixels of a frame that do not move with the scene, such as a time stamp;
    in any size. They are replaced by the mean of the other pixels of their block.
    """

    def __init__(self, fixed: np.ndarray | None = None) -> None:
        self._fixed = fixed
        self._reference: np.ndarray | None = None  # (N, 32, 17) complex: spectra of textured blocks
        self._textured = np.zeros(0, bool)  # (M,): the blocks of the reference that have texture
        self._before = 0.0  # the motion up to the reference
        self._motion = 0.0  # the motion up to the last frame

    def add(self, grey: np.ndarray) -> float:
        """Take the next frame; returns the motion from the first frame to this one.

        The motion is a fraction of the longest side of a frame. It never decreases.

        ``grey``: (H, W) uint8, a copy of `SHARPNESS_SIDE`. The frames of a video normally have the
        same size. A change of the size counts as a cut.
        """
        height, width = grey.shape
        factor = max(1, min(max(grey.shape) // _MOTION_SIDE, min(grey.shape) // _BLOCK))
        small = np.asarray(Image.fromarray(grey).reduce(factor)) if factor > 1 else grey
        if min(small.shape) < _BLOCK:
            return self._motion  # too small to be measured
        blocks = _blocks(small, self._fixed)
        largest = _BLOCK / 2
        if self._reference is None:
            self._set_reference(blocks)
            return self._motion
        if len(blocks) != len(self._textured):
            shift = largest
        elif not self._textured.any():  # the reference is black, for example
            shift = largest if _textured(blocks).any() else 0.0
        else:
            shift, agreement = _shift(self._reference, _spectrum(blocks[self._textured]))
            shift = largest if agreement < _MIN_AGREEMENT else shift
        self._motion = max(self._motion, self._before + shift * factor / max(height, width))
        if shift >= _NEW_REFERENCE:
            self._set_reference(blocks)
        return self._motion

    def _set_reference(self, blocks: np.ndarray) -> None:
        self._textured = _textured(blocks)
        self._reference = _spectrum(blocks[self._textured])
        self._before = self._motion


def _blocks(grey: np.ndarray, fixed: np.ndarray | None) -> np.ndarray:
    """(H, W) to (N, 32, 32) float32: all complete blocks, centred in the image. ``fixed``: as for
    `FrameMotion`."""
    blocks = _divide(grey.astype(np.float32))
    if fixed is None:
        return blocks
    size = grey.shape[1], grey.shape[0]
    resized = Image.fromarray(fixed.astype(np.uint8) * 255).resize(size, Image.Resampling.BOX)
    free = _divide(np.asarray(resized)) == 0
    count = np.maximum(free.sum(axis=(1, 2), keepdims=True), 1)
    mean = np.where(free, blocks, 0).sum(axis=(1, 2), keepdims=True) / count
    return np.where(free, blocks, mean)


def _divide(image: np.ndarray) -> np.ndarray:
    rows, columns = image.shape[0] // _BLOCK, image.shape[1] // _BLOCK
    top = (image.shape[0] - rows * _BLOCK) // 2
    left = (image.shape[1] - columns * _BLOCK) // 2
    part = image[top : top + rows * _BLOCK, left : left + columns * _BLOCK]
    return part.reshape(rows, _BLOCK, columns, _BLOCK).swapaxes(1, 2).reshape(-1, _BLOCK, _BLOCK)


def _textured(blocks: np.ndarray) -> np.ndarray:
    """(N,) bool: the half of the blocks with the most contrast, except blocks without contrast."""
    contrast = blocks.std(axis=(1, 2))
    return contrast >= max(float(np.median(contrast)), _MIN_CONTRAST)


def _spectrum(blocks: np.ndarray) -> np.ndarray:
    """The Fourier transforms of blocks: (N, 32, 32) to (N, 32, 17) complex. A Hann window fades the
    blocks out at their edges; otherwise the edges would correlate."""
    fade = np.hanning(_BLOCK + 2)[1:-1].astype(np.float32)
    return np.fft.rfft2((blocks - blocks.mean(axis=(1, 2), keepdims=True)) * fade[:, None] * fade)


def _shift(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """The shift between two frames in pixels, and the agreement; both are medians over the blocks.

    The agreement of a block, 0..1, is the share of the frequencies whose phases agree with the
    shift. There must be at least one block.

    Args:
        first: (N, 32, 17) complex, the spectra of blocks of one frame (`_spectrum`).
        second: the spectra of the same blocks of the other frame.
    """
    cross = first * np.conj(second)
    size = np.abs(cross)
    # Normalise the spectrum to phases, but suppress frequencies with hardly any energy.
    scale = size + 1e-3 * size.max(axis=(1, 2), keepdims=True) + 1e-9
    surface = np.fft.irfft2(cross / scale, s=(_BLOCK, _BLOCK)).reshape(len(cross), -1)
    weights = size / scale
    # The first and the last column occur once in the whole spectrum, the others twice.
    whole = 2 * weights.sum(axis=(1, 2)) - weights[:, :, 0].sum(1) - weights[:, :, -1].sum(1)
    agreement = surface.max(axis=1) * _BLOCK**2 / np.maximum(whole, 1e-9)
    shifts = np.stack(np.divmod(surface.argmax(axis=1), _BLOCK))
    shifts = (shifts + _BLOCK // 2) % _BLOCK - _BLOCK // 2
    return float(np.median(np.hypot(*shifts))), float(np.median(agreement))
