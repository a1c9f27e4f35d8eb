"""Writes renderings as PNG files: colours in 8 bits, depth in 16 bits or in colours."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image
from torch import Tensor

from snowsplat.scene.render import in_colors
from snowsplat.trajectory.video_file import panorama_xmp
from snowsplat.util.files import atomic_path

# Anchors of a colour map from far (0) to near (1) of increasing lightness: violet to yellow.
_DEPTH_COLORS = np.array(
    [[68, 1, 84], [65, 68, 135], [42, 120, 142], [34, 168, 132], [122, 209, 81], [253, 231, 37]],
    np.float32,
)
_MIN_ALPHA = 0.5  # below this alpha, a pixel mostly shows the background, which has no depth


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write (H, W, 3) uint8 or (H, W) uint16, atomically."""
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG", compress_level=3)


def write_panorama(path: Path, pixels: np.ndarray) -> None:
    """Write (H, W, 3) uint8, equirectangular, as a JPEG file that says so, atomically."""
    image = Image.fromarray(pixels)
    with atomic_path(path) as temporary:
        image.save(
            temporary, format="JPEG", quality=95, subsampling=0, xmp=panorama_xmp(*image.size)
        )


def mean_depth(depth: Tensor, alpha: Tensor) -> np.ndarray:
    """(H, W) float32, world units: mean camera z of a pixel, Σ T α z / Σ T α.

    0 where the pixel mostly shows the background, which has no depth.
    """
    mean = depth / alpha.clamp_min(1e-6)
    mean[alpha < _MIN_ALPHA] = 0.0
    return mean.cpu().numpy()


def depth_range(depths: Sequence[np.ndarray]) -> tuple[float, float]:
    """Near and far for depth images (H, W): percentiles 1 and 99 of the depths that are not 0."""
    shown = np.concatenate([np.zeros(0, np.float32), *(depth[depth > 0] for depth in depths)])
    if not shown.size:
        return 1.0, 2.0
    near, far = np.percentile(shown, [1, 99])
    return float(near), max(float(far), 1.001 * float(near))


def depth_in_16_bits(depth: np.ndarray) -> tuple[np.ndarray, float]:
    """(H, W) uint16, and the world units of one step of these values."""
    step = (float(depth.max()) or 1.0) / 65535.0
    return np.clip(np.rint(depth / step), 0, 65535).astype(np.uint16), step


def depth_in_color(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """(H, W, 3) uint8, from near (yellow) to far (violet); black where there is no depth.

    Colours are linear in disparity, 1/z, so that near distances are resolved better.
    """
    with np.errstate(divide="ignore"):
        t = (1.0 / depth - 1.0 / far) / (1.0 / near - 1.0 / far)
    color = in_colors(np.nan_to_num(t), _DEPTH_COLORS)
    return np.where(depth[:, :, None] > 0, color, 0.0).astype(np.uint8)


class PngQueue:
    """Writes images in background threads, because encoding PNG takes longer than rendering.

    At most eight images are queued. Leaving the context waits for all of them.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(2)
        self._pending: deque[Future[None]] = deque()

    def __enter__(self) -> PngQueue:
        return self

    def __exit__(self, *error: object) -> None:
        with self._pool:
            if error[0] is None:
                while self._pending:
                    self._pending.popleft().result()

    def write(self, path: Path, pixels: np.ndarray) -> None:
        """Queue an image for `write_png`. Raises: OSError: an earlier one could not be written."""
        self._pending.append(self._pool.submit(write_png, path, pixels))
        if len(self._pending) > 8:
            self._pending.popleft().result()
