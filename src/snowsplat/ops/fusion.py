"""`fuse_depth`: adds a depth map to a truncated signed distance field, or a photo to points."""

import torch
from torch import Tensor

from snowsplat.ops.check import check_float, check_tensor, variant
from snowsplat.ops.native import launch


@torch.no_grad()
def fuse_depth(
    sums: Tensor,
    origins: Tensor,
    spacing: float,
    to_image: Tensor,
    depth: Tensor,
    weight: Tensor,
    truncation: float,
    image: Tensor | None = None,
) -> None:
    """Adds what the depth map of a view says about samples to their sums, in place.

    The samples are in cubes of side³ points, and side 1 makes them single points. A sample that the
    view shows at pixel (u, v) with the depth z, where the depth map has d and the weight w, gets

        sums += (w', w' s, w' c),   s = min((d − z) / truncation, 1),   w' = w min(1, 1 + s)

    unless d is unknown or s ≤ −1. So Σ w' s / Σ w' is the truncated signed distance, positive in
    front of the surface (Curless and Levoy 1996). d is interpolated between four pixels if their
    depths differ by less than ``truncation``; otherwise it is that of the nearest pixel, as w
    always is. With an image, samples with s = 1 get nothing, and c is interpolated. Not
    differentiable.

    Args:
        sums: (cubes, side, side, side, 2 + C), contiguous; the indices of a sample are z, y, x.
        origins: (cubes, 3), the positions of the first samples, world frame.
        spacing: of the samples of a cube, world units.
        to_image: (3, 4), K [R | t]: a world point x is shown at (u, v) pixels with the depth z,
            where (u z, v z, z) = K [R | t] (x, 1).
        depth: (H, W), camera z in world units. 0: unknown; infinite: there is no surface.
        weight: (H, W), at least 0.
        truncation: world units, > 0.
        image: (C, H, W), C ≤ 4; None: C = 0.

    Raises:
        ValueError: a wrong shape, dtype or device, or a truncation that is not positive.
    """
    op = "fuse_depth"
    check_float(op, "sums", sums)
    channels = 0 if image is None else len(image)
    cubes, side = len(origins), sums.shape[1] if sums.dim() == 5 else 1
    check_tensor(op, "sums", sums, (cubes, side, side, side, 2 + channels), sums)
    check_tensor(op, "origins", origins, (cubes, 3), sums)
    check_tensor(op, "to_image", to_image, (3, 4), sums)
    check_tensor(op, "depth", depth, (None, None), sums)
    height, width = depth.shape
    check_tensor(op, "weight", weight, (height, width), sums)
    if image is not None:
        check_tensor(op, "image", image, (channels, height, width), sums)
    if channels > 4 or width * height >= 2**31:
        raise ValueError(
            f"{op}: at most 4 channels and 2³¹ pixels, got {channels} and {width}×{height}"
        )
    if not truncation > 0:
        raise ValueError(f"{op}: truncation must be positive, got {truncation:g}")
    launch(
        variant(op, sums),
        n=cubes * side**3,
        side=side,
        spacing=float(spacing),
        origins=origins.contiguous(),
        to_image=to_image.contiguous(),
        width=width,
        height=height,
        depth=depth.contiguous(),
        weight=weight.contiguous(),
        channels=channels,
        image=None if image is None else image.contiguous(),
        truncation=float(truncation),
        sums=sums,
    )
