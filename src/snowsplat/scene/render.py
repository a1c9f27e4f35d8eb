"""`render`: Gaussians and a camera -> an image."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from snowsplat import ops
from snowsplat.ops import Splats2D, View
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians


@dataclass
class RenderOutput:
    """A rendered image.

    The depth is Σ T α z. It is not divided by alpha: depth / alpha is the expected depth where
    alpha > 0.
    """

    image: Tensor  # (H, W, 3) in [0, ∞); planar storage (`permute` of (3, H, W))
    alpha: Tensor  # (H, W) in [0, 1]
    depth: Tensor | None  # (H, W), world units
    splats: Splats2D


#: Gaussians, camera, background (3,) and SH degree (None: all) → an image; `render` is one.
Renderer = Callable[[Gaussians, Camera, Tensor, int | None], RenderOutput]


def view_of(gaussians: Gaussians, camera: Camera, sh_degree: int | None = None) -> View:
    """The camera as an argument of the numerical operations on these Gaussians.

    ``sh_degree``: the largest SH degree to use; None uses all degrees of the Gaussians.
    """
    degree = gaussians.sh_degree if sh_degree is None else min(sh_degree, gaussians.sh_degree)
    return View(
        camera.cam_from_world,
        camera.width,
        camera.height,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        sh_degree=degree,
        near=camera.near,
        antialiased=gaussians.antialiased,
    )


def project(gaussians: Gaussians, camera: Camera, sh_degree: int | None = None) -> Splats2D:
    """The 2D splats of the Gaussians in the image of the camera: the first half of `render`."""
    return ops.project(gaussians, view_of(gaussians, camera, sh_degree))


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Tensor | None = None,
    sh_degree: int | None = None,
    *,
    with_depth: bool = False,
) -> RenderOutput:
    """Render the Gaussians from a camera.

    Differentiable with respect to all parameters of the Gaussians, ``camera.cam_from_world`` and
    ``background``.

    Args:
        gaussians: N Gaussians in the world frame.
        camera: the camera.
        background: (3,) RGB; None is black.
        sh_degree: the largest SH degree to use; None uses all degrees of the Gaussians.
        with_depth: also return the depth.
    """
    splats = project(gaussians, camera, sh_degree)
    if background is not None:
        background = background.to(splats.packed.device)
    image, alpha, depth = ops.rasterize(
        splats, camera.width, camera.height, background, with_depth=with_depth
    )
    return RenderOutput(image, alpha, depth, splats)


def to_8bit(image: Tensor) -> np.ndarray:
    """(H, W, 3) in 0..1 -> uint8, rounded to the nearest."""
    return (image.clamp(0.0, 1.0) * 255.0 + 0.5).byte().contiguous().cpu().numpy()


def in_colors(values: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """(H, W) numbers in 0..1 -> (H, W, 3) float32, interpolated between ``colors`` (K, 3)."""
    position = np.clip(values, 0.0, 1.0) * (len(colors) - 1)
    low = np.minimum(position.astype(np.int64), len(colors) - 2)
    share = (position - low)[:, :, None]
    return np.rint(colors[low] * (1.0 - share) + colors[low + 1] * share)
