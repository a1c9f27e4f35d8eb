"""`plane_sweep`: inverse depths of a view from other views with known poses."""

import math

import torch
from torch import Tensor

from snowsplat.ops.check import check_float, check_size, check_tensor, variant
from snowsplat.ops.native import launch
from snowsplat.util.native_layout import MAX_SWEEP_RADIUS, MAX_SWEEP_SOURCES


@torch.no_grad()
def plane_sweep(
    image: Tensor,
    sources: Tensor,
    source_from_pixel: Tensor,
    min_inverse_depth: float,
    max_inverse_depth: float,
    *,
    planes: int = 64,
    radius: int = 3,
    centre: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """The inverse depth of every pixel of a view by a plane sweep over S source views.

    For each plane, the windows around a pixel in the view and in the sources are compared (Collins
    1996; Gallup et al. 2007, without their slanted planes). Not differentiable.

    The score of a pixel at a plane is the mean of the two highest zero-mean normalised
    cross-correlations (ZNCC) among the sources, or that of the only source. A source does not count
    if a pixel of the window lies outside of the source at this plane, or behind its camera. The
    window is clipped at the border of ``image``. The result is the plane with the highest score,
    refined by the parabola through its score and those of the planes before and after it.

    Args:
        image: (H, W) luminance in [0, 1], float32 or float64. NaN: no value; windows that contain
            such a pixel do not count.
        sources: (S, Hs, Ws) luminance of the sources, 1 ≤ S ≤ 8; Hs, Ws ≥ 2. NaN: as in ``image``.
        source_from_pixel: (S, 3, 4) the matrix [A | b] of each source. The pixel with the centre
            (u, v), at +0.5, and with inverse depth w is at q = A (u, v, 1) + w b, which is pixel
            position (q.x / q.z, q.y / q.z) of the source. The source is bilinearly interpolated
            between the centres of its pixels. q.z ≤ 0: the point is behind the camera.
        min_inverse_depth, max_inverse_depth: of the first and the last plane, in 1 / world units,
            where depth is z of the camera. The planes between them have equal distances in inverse
            depth. Without ``centre``, 0 ≤ min < max.
        planes: their number, 2 or more.
        radius: r of the window of (2 r + 1)² pixels, 1 to 7.
        centre: (H, W), or None. It is added to the inverse depths of the planes at each pixel: a
            search near a known depth has the range −h, h. Inverse depths below 0 do not count.
            Each pixel of a window has its own centre.

    Returns:
        inverse_depth (H, W) and score (H, W), −1 to 1, in the dtype of ``image``. They are 0 and −1
        for pixels without a result: no source sees the window at any plane, or the standard
        deviation of the luminance in the window is below 1/255.

    Raises:
        ValueError: a wrong shape or dtype, or a number outside of its range.
    """
    op = "plane_sweep"
    check_float(op, "image", image)
    check_tensor(op, "image", image, (None, None), image)
    height, width = image.shape
    check_size(op, width, height)
    check_tensor(op, "sources", sources, (None, None, None), image)
    count, source_height, source_width = sources.shape
    if not 1 <= count <= MAX_SWEEP_SOURCES:
        raise ValueError(f"{op}: there must be 1 to {MAX_SWEEP_SOURCES} sources, got {count}")
    if min(source_width, source_height) < 2 or source_width * source_height >= 2**31:
        raise ValueError(
            f"{op}: sources must be at least 2×2 and have fewer than 2³¹ pixels, "
            f"got {source_width}×{source_height}"
        )
    check_tensor(op, "source_from_pixel", source_from_pixel, (count, 3, 4), image)
    low, high = min_inverse_depth, max_inverse_depth
    if not -math.inf < low < high < math.inf or (centre is None and low < 0):
        raise ValueError(
            f"{op}: the inverse depths must be 0 ≤ min < max, got {low:g} and {high:g}"
        )
    if planes < 2:
        raise ValueError(f"{op}: planes must be 2 or more, got {planes}")
    if not 1 <= radius <= MAX_SWEEP_RADIUS:
        raise ValueError(f"{op}: radius must be 1 to {MAX_SWEEP_RADIUS}, got {radius}")
    if centre is not None:
        check_tensor(op, "centre", centre, (height, width), image)
        centre = centre.contiguous()
    inverse_depth, score = image.new_empty(height, width), image.new_empty(height, width)
    launch(
        variant(op, image),
        n=count,
        width=width,
        height=height,
        source_width=source_width,
        source_height=source_height,
        image=image.contiguous(),
        sources=sources.contiguous(),
        source_from_pixel=source_from_pixel.contiguous(),
        centre=centre,
        first=float(low),
        step=(high - low) / (planes - 1),
        planes=planes,
        radius=radius,
        inverse_depth=inverse_depth,
        score=score,
    )
    return inverse_depth, score
