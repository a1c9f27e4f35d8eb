"""`normals_of_depth`: the normals of the surface that a depth map shows."""

import torch
from torch import Tensor
from torch.nn.functional import pad

from snowsplat.scene.camera import Camera


def normals_of_depth(depth: Tensor, camera: Camera) -> Tensor:
    """(3, H, W) unit normals in the camera frame, towards the camera; 0 at the border of the map.

    They are the normalised cross product of the differences of neighbouring points, across two
    pixels, in both directions (Huang et al. 2024, 2DGS, eq. 15). Differentiable in ``depth``.

    Args:
        depth: (H, W) camera z in world units.
        camera: of the size of the map.
    """
    points = rays_of(camera, depth) * depth
    a, b, c = (points[:, 2:, 1:-1] - points[:, :-2, 1:-1]).unbind()
    d, e, f = (points[:, 1:-1, 2:] - points[:, 1:-1, :-2]).unbind()
    # Down × right: right × down points away from the camera. On a CPU, `cross` and `norm` take
    # several times as long for planes.
    normals = torch.stack([b * f - c * e, c * d - a * f, a * e - b * d])
    squares = normals.square().sum(0).clamp_min(torch.finfo(depth.dtype).tiny)
    return pad(normals * squares.rsqrt(), (1, 1, 1, 1))


def interior_pixels(shown: Tensor) -> Tensor:
    """(H, W) bool: the pixels that are shown with all eight around them; False at the border."""
    rows = shown[:, :-2] & shown[:, 1:-1] & shown[:, 2:]
    return pad(rows[:-2] & rows[1:-1] & rows[2:], (1, 1, 1, 1))


def rays_of(camera: Camera, like: Tensor) -> Tensor:
    """(3, H, W): the rays through the pixels, in the camera frame, with z = 1; of the dtype and on
    the device of ``like``.
    """
    u = (torch.arange(camera.width).to(like) + 0.5 - camera.cx) / camera.fx
    v = (torch.arange(camera.height).to(like) + 0.5 - camera.cy) / camera.fy
    x, y = torch.meshgrid(u, v, indexing="xy")
    return torch.stack([x, y, torch.ones_like(x)])
