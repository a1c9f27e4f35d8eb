"""Resamples photos and masks for a pinhole view. The centre of the first pixel is at (0.5, 0.5).

Photos are sampled with Catmull-Rom splines, which have at most a third of the error of bilinear
interpolation. Training uses every pixel, so blur added here would limit its quality.
"""

import numpy as np
from PIL import Image

from snowsplat.data.lens.views import LensView
from snowsplat.util.native_library import call_with_arrays


def undistort_image(image: Image.Image, view: LensView) -> Image.Image:
    """A photo, "L", "RGB" or "RGBA", resampled to the view; same mode."""
    if view.is_photo:
        return image
    # Premultiplied alpha, so that the colours of transparent pixels do not affect other pixels.
    mode = "RGBa" if image.mode == "RGBA" else image.mode
    pixels = np.asarray(image.convert(mode)).reshape(image.height, image.width, -1)
    made = resample(pixels.transpose(2, 0, 1), view, view.width, view.height)
    pixels = np.ascontiguousarray(made.transpose(1, 2, 0))
    return Image.frombytes(mode, (view.width, view.height), pixels.tobytes()).convert(image.mode)


def undistort_mask(mask: Image.Image, view: LensView) -> Image.Image:
    """A mask, "L", resampled to the view: 255 where at least half of a pixel is set."""
    return undistort_image(mask, view).point(lambda value: 255 * (value >= 128))


def resample(
    planes: np.ndarray, view: LensView, width: int, height: int, scale: tuple[float, float] = (1, 1)
) -> np.ndarray:
    """(C, height, width) uint8: a photo (C, H, W) uint8 seen by a view at the given size.

    ``scale``: the size of the photo divided by that of the lens, for x and y. Positions outside of
    the photo get the colour of its border.
    """
    made: np.ndarray = np.empty((len(planes), height, width), np.uint8)
    source = np.ascontiguousarray(planes)
    for rows, positions in view.positions(width, height):
        nodes = positions.nodes * np.array(scale, np.float32)
        call_with_arrays(
            "resample",
            channels=len(planes),
            source_width=planes.shape[2],
            source_height=planes.shape[1],
            source=source,
            wraps=view.wraps,
            columns=nodes.shape[1],
            nodes=nodes,
            column=positions.column,
            across=positions.across,
            row=positions.row,
            down=positions.down,
            width=width,
            height=height,
            first=rows.start,
            count=rows.stop - rows.start,
            made=made,
        )
    return made


def nearest(values: np.ndarray, view: LensView, width: int, height: int) -> np.ndarray:
    """(height, width, …) float32: a map (H, W, …) of a photo, such as its depth, seen by a view.

    Nearest values, because a mean of two surfaces is on neither. NaN where the photo shows nothing.
    """
    scale = np.array([values.shape[1] / view.lens.width, values.shape[0] / view.lens.height])
    made = np.full((height, width, *values.shape[2:]), np.nan, np.float32)
    for rows, position in view.strips(width, height):
        shown = view.covered(position) & np.isfinite(position).all(-1)
        column, row = np.floor(position[shown] * scale).astype(np.int64).T
        column = column % values.shape[1] if view.wraps else column.clip(0, values.shape[1] - 1)
        row = row.clip(0, values.shape[0] - 1)
        made[rows][shown] = values[row, column]
    return made
