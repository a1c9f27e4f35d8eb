"""Detects SIFT features in a photo (Lowe 2004), with a native function.

The parameters of the detection are the defaults of COLMAP.
"""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from snowsplat.sfm.ingest.photos.photo_files import open_image
from snowsplat.util.image_size import scaled_size
from snowsplat.util.machine import memory_bytes
from snowsplat.util.native_library import call_with_arrays, check_array

# Memory for each pixel of the resized photo. The first octave has 4 pixels for each pixel of the
# photo; three levels of blur are kept, float32. The other octaves together have a third of its
# pixels.
_BYTES_PER_PIXEL = 4 * 3 * 4 * 4 // 3
# The part of the machine's memory that all these pyramids may use.
_MEMORY_PART = 0.25


class Features(NamedTuple):
    """The features of a photo, in the format of COLMAP's database.

    A keypoint has its position x, y in pixels of the photo, where the centre of the first pixel is
    (0.5, 0.5); and a 2 x 2 matrix in row order: its scale in pixels times its rotation. The
    descriptors are "RootSIFT" (Arandjelović and Zisserman 2012): histograms of the gradients are
    divided by their sum; the square roots of these values are multiplied by 512.
    """

    keypoints: NDArray[np.float32]  # (N, 6)
    descriptors: NDArray[np.uint8]  # (N, 128)


def photos_at_once(image_size: int, threads: int) -> int:
    """The number of photos that `detect_sift` can process in parallel in the available memory."""
    needed = _BYTES_PER_PIXEL * image_size**2
    available = _MEMORY_PART * memory_bytes()
    return min(threads, max(1, int(available / needed))) if available else threads


def detect_sift(photo: Path, mask: Path | None, image_size: int, count: int) -> Features:
    """The ``count`` largest features of a photo, or fewer.

    If the longest side of the photo has more than ``image_size`` pixels, the photo is resized to
    this size. The largest features are used because they are found again in more of the other
    photos. Features at black pixels of ``mask`` are left out.

    Raises:
        OSError: a file is missing.
        Exception: any other that Pillow raises for a damaged file.
        MemoryError: not enough memory.
        UserError: the native library is missing or outdated.
    """
    grey, size = read_grey(photo, image_size)
    found = detect_in_grey(grey, None if mask is None else read_mask(mask, grey), count)
    stretch = np.array(size, np.float32) / grey.shape[::-1]
    found.keypoints[:, :2] *= stretch
    found.keypoints[:, 2:] *= stretch.mean()
    return found


def detect_in_grey(
    grey: NDArray[np.uint8], allowed: NDArray[np.uint8] | None, count: int
) -> Features:
    """The ``count`` largest features of a grey image (H, W), in pixels of this image.

    ``allowed`` (H, W) is 0 where no feature is wanted.

    Raises:
        ValueError: a wrong shape or dtype.
        MemoryError: not enough memory.
        UserError: the native library is missing or outdated.
    """
    height, width = grey.shape
    check_array("grey", grey, (height, width), np.uint8)
    if allowed is not None:
        check_array("allowed", allowed, (height, width), np.uint8)
    keypoints, descriptors = np.empty((count, 6), np.float32), np.empty((count, 128), np.uint8)
    found = call_with_arrays(
        "detect_sift",
        width=width,
        height=height,
        grey=np.ascontiguousarray(grey),
        allowed=None if allowed is None else np.ascontiguousarray(allowed),
        count=count,
        keypoints=keypoints,
        descriptors=descriptors,
    )
    if found < 0:
        raise MemoryError("not enough memory to detect features in a photo")
    return Features(keypoints[:found], descriptors[:found])


def read_grey(photo: Path, image_size: int) -> tuple[NDArray[np.uint8], tuple[int, int]]:
    """The grey photo (H, W), resized, and its original width and height."""
    cv2.setNumThreads(1)  # other photos are processed in parallel
    with open_image(photo) as image:
        width, height = image.size
        size = scaled_size(width, height, image_size)
        # A JPEG is decoded at 1/2, 1/4 or 1/8 of its size if this is not smaller than ``size``.
        image.draft("L", size)
        grey = np.asarray(image.convert("L"))
    if grey.shape[::-1] != size:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return grey, (width, height)


def read_mask(mask: Path, grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W): the mask in the size of the resized photo."""
    height, width = grey.shape
    with open_image(mask) as image:
        return np.asarray(image.convert("L").resize((width, height), Image.Resampling.NEAREST))
