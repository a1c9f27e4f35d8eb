"""`render`: what a camera sees of the Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from snowsplat import ops
from snowsplat.ops import Splats2D
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians


@dataclass
class RenderOutput:
    """image (H, W, 3) linear in [0, ∞), alpha (H, W) in [0, 1], depth (H, W) or None, the splats.

    The depth is Σ T α z, in world units and not divided by alpha: divide where alpha > 0 to get the
    expected depth of what is there. The image has planar storage (`permute` of (3, H, W)).
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor | None
    splats: Splats2D


def project(gaussians: Gaussians, camera: Camera, sh_degree: int | None = None) -> Splats2D:
    """The 2D splats of the Gaussians in the camera's image: the first half of `render`."""
    degree = gaussians.sh_degree if sh_degree is None else min(sh_degree, gaussians.sh_degree)
    return ops.project(
        gaussians.means,
        gaussians.log_scales,
        gaussians.quats,
        gaussians.opacity_logits,
        gaussians.sh_dc,
        gaussians.sh_rest,
        camera.cam_from_world,
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        sh_degree=degree,
    )


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Tensor | None = None,
    sh_degree: int | None = None,
    *,
    with_depth: bool = False,
) -> RenderOutput:
    """Renders the Gaussians from a camera over a background colour (3,), default black.

    `sh_degree` limits the view dependence (default: all that the Gaussians have). Differentiable
    with respect to every parameter of the Gaussians, `camera.cam_from_world` and `background`.
    """
    splats = project(gaussians, camera, sh_degree)
    if background is not None:
        background = background.to(splats.packed.device)
    image, alpha, depth = ops.rasterize(
        splats, camera.width, camera.height, background, with_depth=with_depth
    )
    return RenderOutput(image, alpha, depth, splats)
