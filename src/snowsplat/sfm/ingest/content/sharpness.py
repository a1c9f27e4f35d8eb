"""Sharpness of an image, and tests for images without content.

All functions use small grey copies of images, (H, W) uint8. The copies contain the detail that SfM
needs, and little noise.
"""

import cv2
import numpy as np
from PIL import Image

from snowsplat.util.image_size import scaled_size
from snowsplat.util.messages import Message, message

#: Longest side in pixels of the copies that are compared for sharpness. A blur of half a pixel of
#: the copy is still detected, while noise of the sensor and of compression is mostly averaged out.
SHARPNESS_SIDE = 640
#: Longest side in pixels of the copies that are tested for content, and for camera motion.
CONTENT_SIDE = 320

# Longest side of a copy in pixels -> minimum of `fine_detail` for this copy. An image with less is
# unusable. The minima follow from photos of three real datasets (1000 to 1280 pixels), which were
# blurred by Gaussian filters with a standard deviation of σ pixels and saved as JPEG with quality
# 75 and 95. With pycolmap's SIFT, neighbouring photos have 21 to 107 inlier matches at σ = 8, 0 to
# 20 at σ = 12, and none at σ = 16. `fine_detail` is
#          longest side      sharp        σ = 8        12           16           24 and 32
#                   160    0.60 to 0.74  0.18 to 0.24  0.09 to 0.14  0.06 to 0.12  0.04 to 0.15
#                    80    0.60 to 0.75  0.39 to 0.47  0.24 to 0.32  0.17 to 0.23  0.07 to 0.14
# At 160, the values increase again for heavily blurred images because of JPEG blocks, which are not
# visible at 80.
_MIN_DETAIL = {160: 0.09, 80: 0.16}
# Minimum range of the grey levels (0.5% to 99.5% quantile) of an image with content. A photo with
# the lens cap on has 2 to 5.
_MIN_RANGE = 8.0
# Grey levels. An image without content is black if all of it is darker than the first one, and
# white if all of it is brighter than the second one.
_BLACK, _WHITE = 64, 191
_SMALLEST = 8  # pixels: smaller copies have no detail that could be measured

# Reasons why an image is unusable.
BLACK = message("is completely black")
WHITE = message("is completely white")
FLAT = message("is completely of one colour")
BLURRED = message("is too blurred")


def grey_copy(image: Image.Image, side: int) -> np.ndarray:
    """(H, W) uint8 grey copy of an image, with its longest side at most about ``side`` pixels."""
    factor = max(1, max(image.size) // (2 * side))
    if factor > 1:  # first by an integer factor, which is several times faster
        image = image.reduce(factor)
    size = scaled_size(*image.size, side)
    grey = image.convert("L")
    return np.asarray(grey if grey.size == size else grey.resize(size, Image.Resampling.BOX))


def sharpness(grey: np.ndarray) -> float:
    """Variance of the Laplacian, for comparing frames of one scene; it has no absolute meaning.

    In a real video with motion blur in half of its frames, this measure selected an unblurred frame
    more often than the gradient energy, the product of the energies of both axes, or a mean of
    these measures.
    """
    detail = cv2.Laplacian(grey, cv2.CV_16S)[1:-1, 1:-1]
    # The copy may have only a few pixels.
    return float(cv2.meanStdDev(detail)[1].item() ** 2) if detail.size else 0.0


def why_unusable(grey: np.ndarray) -> Message | None:
    """The reason why an image is unusable for SfM, or None. ``grey``: a copy of `CONTENT_SIDE`."""
    low, high = np.quantile(grey, [0.005, 0.995])
    if high - low < _MIN_RANGE:
        return BLACK if high < _BLACK else WHITE if low > _WHITE else FLAT
    # Motion blur keeps the detail perpendicular to its direction: such an image is still usable.
    blurred = any(max(fine_detail(grey, side)) < least for side, least in _MIN_DETAIL.items())
    return BLURRED if blurred else None


def fine_detail(grey: np.ndarray, side: int) -> tuple[float, float]:
    """The share of the gradient energy, 0..1, that a blur at the scale of 1/``side`` removes.

    This share does not depend on the contrast. It hardly depends on the content, because images of
    real scenes have detail at all scales, unless defocus or motion blur removes it.

    Returns: The share of the vertical and that of the horizontal gradient.
    """
    small = grey_copy(Image.fromarray(grey), side).astype(np.float32)
    if min(small.shape) < _SMALLEST:
        return 1.0, 1.0
    blurred = (small[:-2] + 2 * small[1:-1] + small[2:]) / 4
    blurred = (blurred[:, :-2] + 2 * blurred[:, 1:-1] + blurred[:, 2:]) / 4

    def share(axis: int) -> float:
        before = float((np.diff(small[1:-1, 1:-1], axis=axis) ** 2).mean())
        after = float((np.diff(blurred, axis=axis) ** 2).mean())
        return 1 - after / before if before > 0 else 0.0

    return share(0), share(1)
