"""How sharp a picture is, whether it shows anything, and whether the camera moved between two.

All work on small grey copies (H, W) uint8: what SfM lives on is still there, noise is not.
"""

from __future__ import annotations

import numpy as np
from PIL import Image

#: Longest side of the copies on which frames are compared for sharpness: blur of half a pixel here
#: is told from none, and the noise of the sensor and of compression is mostly averaged out.
FRAME_SIDE = 640
#: Longest side of the copies on which a picture is judged by itself, and on which motion is found.
PICTURE_SIDE = 320

# Fine detail below which a picture is useless, on copies of two longest sides; see `_fine_detail`.
# Measured with pycolmap's SIFT on three real datasets of 1000 to 1280 pixels, blurred by Gaussians
# saved as JPEG of 75 and 95: at σ = 8 pixels neighbours have 21 to 107 matches that fit, at 12 they
# have 0 to 20, at 16 none.     sharp        σ = 8        12           16           24 and 32
#   longest side of 160    0.60 to 0.74  0.18 to 0.24  0.09 to 0.14  0.06 to 0.12  0.04 to 0.15
#                    80    0.60 to 0.75  0.39 to 0.47  0.24 to 0.32  0.17 to 0.23  0.07 to 0.14
# What is seen again of heavily blurred ones at 160 are the squares of JPEG; at 80 they are gone.
_BLURRED = {160: 0.09, 80: 0.16}
# Grey levels between nearly the darkest and nearly the brightest. A lens cap has 2 to 5 of them.
_BLANK = 8.0
# Pixels of the copy; 0.6% of its longest side. A still camera gives 0 or 1, noisy as it may be; a
# hand-held one that walks gives 3 to 10 within 0.4 s.
_MOVED = 2.0
_BLOCK = 32


def grey_copy(image: Image.Image, side: int) -> np.ndarray:
    """(H, W) uint8 grey of an image, its longest side at most about ``side``."""
    factor = max(1, max(image.size) // (2 * side))
    if factor > 1:  # a whole factor first: that is several times faster
        image = image.reduce(factor)
    scale = min(1.0, side / max(image.size))
    size = max(1, round(image.width * scale)), max(1, round(image.height * scale))
    grey = image.convert("L")
    return np.asarray(grey if grey.size == size else grey.resize(size, Image.Resampling.BOX))


def sharpness(grey: np.ndarray) -> float:
    """Variance of the Laplacian. Compares frames of the same things; means nothing by itself.

    Of gradients' energy, their product over both axes, their mean and this, this one found an
    unblurred frame the most often among frames of a real video, half of them with motion blur.
    """
    g = grey.astype(np.float32)
    return float(
        (4 * g[1:-1, 1:-1] - g[:-2, 1:-1] - g[2:, 1:-1] - g[1:-1, :-2] - g[1:-1, 2:]).var()
    )


def why_useless(grey: np.ndarray) -> str | None:
    """Why SfM cannot use a picture, certainly, of which this is a copy of `PICTURE_SIDE`."""
    low, high = np.quantile(grey, [0.005, 0.995])
    if high - low < _BLANK:
        return BLACK if high < 64 else WHITE if low > 191 else FLAT
    blurred = any(_fine_detail(grey, side) < least for side, least in _BLURRED.items())
    return BLURRED if blurred else None


BLACK = "is black all over"
WHITE = "is white all over"
FLAT = "is of one colour all over"
BLURRED = "is blurred all over"


def _fine_detail(grey: np.ndarray, side: int) -> float:
    """The share of the gradients' energy, 0..1, that a blur by 1/``side`` takes away.

    Independent of contrast and nearly so of what is shown: pictures of things have detail at all
    scales, except where the lens or the hand has removed it.
    """
    small = grey_copy(Image.fromarray(grey), side).astype(np.float32)
    if min(small.shape) < 8:
        return 1.0
    blurred = (small[:-2] + 2 * small[1:-1] + small[2:]) / 4
    blurred = (blurred[:, :-2] + 2 * blurred[:, 1:-1] + blurred[:, 2:]) / 4
    shares = []
    for axis in (0, 1):
        before = float((np.diff(small[1:-1, 1:-1], axis=axis) ** 2).mean())
        after = float((np.diff(blurred, axis=axis) ** 2).mean())
        shares.append(1 - after / before if before > 0 else 0.0)
    return max(shares)  # motion blur leaves the detail across it


def has_moved(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether the camera moved between two frames, given copies of `PICTURE_SIDE`, equally large.

    The shift of each block is found by phase correlation; what counts is the median over those with
    texture. So somebody who walks through the picture does not make it a different view, and
    neither does noise or the light.
    """
    if min(before.shape) < _BLOCK:
        return bool(np.abs(before.astype(np.float32) - after).mean() >= 1.0)
    first, second = _blocks(before), _blocks(after)
    contrast = first.std(axis=(1, 2))
    textured = contrast >= max(float(np.median(contrast)), 3.0)
    if not textured.any():
        return bool(np.abs(first - second).mean() >= 1.0)
    first, second = _windowed(first[textured]), _windowed(second[textured])
    cross = np.fft.rfft2(first) * np.conj(np.fft.rfft2(second))
    size = np.abs(cross)
    # A floor under the size: frequencies that are hardly there do not vote.
    cross /= size + 1e-3 * size.max(axis=(1, 2), keepdims=True) + 1e-9
    peaks = np.fft.irfft2(cross, s=(_BLOCK, _BLOCK)).reshape(len(cross), -1).argmax(axis=1)
    shifts = np.stack(np.divmod(peaks, _BLOCK))
    shifts = (shifts + _BLOCK // 2) % _BLOCK - _BLOCK // 2
    return bool(np.median(np.hypot(*shifts)) >= _MOVED)


def _blocks(grey: np.ndarray) -> np.ndarray:
    """(H, W) to (N, 32, 32) float32: the blocks that fit, around the middle."""
    rows, columns = grey.shape[0] // _BLOCK, grey.shape[1] // _BLOCK
    top = (grey.shape[0] - rows * _BLOCK) // 2
    left = (grey.shape[1] - columns * _BLOCK) // 2
    part = grey[top : top + rows * _BLOCK, left : left + columns * _BLOCK].astype(np.float32)
    return part.reshape(rows, _BLOCK, columns, _BLOCK).swapaxes(1, 2).reshape(-1, _BLOCK, _BLOCK)


def _windowed(blocks: np.ndarray) -> np.ndarray:
    """Without the mean and fading to the edges, which would correlate with themselves."""
    fade = np.hanning(_BLOCK + 2)[1:-1].astype(np.float32)
    return (blocks - blocks.mean(axis=(1, 2), keepdims=True)) * fade[:, None] * fade
