"""What cameras see of each Gaussian: from where, how large a pixel is there, and how much of it.

The blending weight of a Gaussian in a pixel is w = T α, with the transmittance T in front of it.
Sums of these weights are gradients: Σ w(p) g(p) is the gradient of Σ c(p) g(p), with the rendered
image c and any weights g of the pixels p, with respect to the colour of the Gaussian.

The frusta and the surroundings of cameras are for `points_in_frusta` and `points_in_spheres`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from snowsplat import ops
from snowsplat.ops import Frusta
from snowsplat.ops.splats import COLORS
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import project

#: The entries of a symmetric 3×3 matrix that are stored.
ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
#: Longest side of the images in which weights are summed, in pixels.
SIDE = 400
# At most so many cameras are rendered; more do not change the means below.
_CAMERAS = 16
# A Gaussian is in a view if it is not farther outside of the image, in units of its size.
_MARGIN = 0.1
# The side of a pixel in units of the distance to the third neighbour, if the cameras are unknown.
_SPACING = 0.15


@dataclass
class Sight:
    """What the cameras see of each of N Gaussians; all tensors are float64."""

    weights: Tensor  # (N,) the mean over the views of Σ w, in pixels; all 1 if unknown
    # (N,) the area of a pixel at the Gaussian, in squared world units; 0: negligible.
    pixels: Tensor
    # (6, N) three times the mean of d dᵀ, with the unit vectors d from the cameras; the entries are
    # `ENTRIES`. From everywhere, this is the identity.
    directions: Tensor


def reduced_camera(camera: Camera) -> Camera:
    """The camera with an image of at most about `SIDE` pixels."""
    return camera.downscaled(max(1, round(max(camera.width, camera.height) / SIDE)))


def blended_sums(
    gaussians: Gaussians, camera: Camera, values: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The ids (M,) of the Gaussians in a view, their depths (M,), and (M, 3) Σ w(p) g(p).

    ``values``: (H, W, 3) g for three sums.
    """
    with torch.no_grad():
        splats = project(gaussians, camera)
    splats.packed = splats.packed.detach().requires_grad_()
    with torch.enable_grad():
        image, _, _ = ops.rasterize(splats, camera.width, camera.height)
        (image * values).sum().backward()
    assert splats.ids is not None
    assert splats.packed.grad is not None
    rows = splats.ids >= 0
    return (
        splats.ids[rows].long(),
        splats.depths.detach()[rows],
        splats.packed.grad[rows, COLORS : COLORS + 3],
    )


def sight(gaussians: Gaussians, cameras: Sequence[Camera]) -> Sight:
    """What the cameras see, or what they may see if there are none.

    Without cameras, every Gaussian is seen from everywhere, and pixels are as large as the spacing
    of the Gaussians suggests: training puts about one Gaussian on a few pixels. The pixels of a
    scene that was trained without aliasing have no effect on it.

    Args:
        gaussians: N finite Gaussians on the CPU.
        cameras: the cameras of the photos; some of them, evenly spaced, are used.
    """
    found = _by_cameras(gaussians, cameras) if cameras else _by_spacing(gaussians)
    if gaussians.antialiased:
        found.pixels = torch.zeros_like(found.pixels)
    return found


def _by_spacing(gaussians: Gaussians) -> Sight:
    spacing = ops.neighbours(gaussians.means, k=3)[:, 2].double()
    spacing = torch.where(spacing.isfinite(), spacing, 0.0)
    everywhere = torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    return Sight(
        torch.ones_like(spacing),
        (_SPACING * spacing).square(),
        everywhere[:, None].repeat(1, len(spacing)),
    )


def _by_cameras(gaussians: Gaussians, cameras: Sequence[Camera]) -> Sight:
    used = cameras[:: -(-len(cameras) // _CAMERAS)]
    found = _by_spacing(gaussians)
    means = gaussians.means.double()
    weights, density, squared = torch.zeros(3, len(means), dtype=torch.float64)
    directions = torch.zeros_like(found.directions)
    for camera in used:
        small = reduced_camera(camera)
        ids, _, sums = blended_sums(gaussians, small, torch.ones(small.height, small.width, 3))
        weights[ids] += sums[:, 0].double() * (camera.width / small.width) ** 2
        place, depth = camera.project(means)
        size = torch.tensor([camera.width, camera.height])
        inside = ((place > -_MARGIN * size) & (place < (1 + _MARGIN) * size)).all(1) & (depth > 0)
        # Pixels for a unit of area: the views that show it largest count most.
        pixels = torch.where(inside, camera.fx * camera.fy / depth.square(), 0.0)
        towards = normalize(means - camera.position.double(), dim=1)
        directions += pixels * torch.stack([towards[:, i] * towards[:, j] for i, j in ENTRIES])
        density += pixels
        squared += pixels.square()
    seen = density > 0
    found.weights = weights / len(used)
    found.directions[:, seen] = 3.0 * directions[:, seen] / density[seen]
    found.pixels[seen] = density[seen] / squared[seen]
    return found


def frusta_of(cameras: Sequence[Camera], depths: Sequence[tuple[float, float]]) -> Frusta:
    """The frusta of V cameras, in float64 on their device.

    ``depths``: for each camera the range of depths, world units.
    """
    double, device = torch.float64, cameras[0].cam_from_world.device
    size = [(c.width, c.height) for c in cameras]
    return Frusta(
        torch.stack([c.intrinsics.to(device) @ c.cam_from_world.to(double) for c in cameras]),
        torch.tensor(size, dtype=double, device=device),
        torch.tensor(depths, dtype=double, device=device),
        torch.tensor([max(c.fx, c.fy) for c in cameras], dtype=double, device=device),
    )


def spheres_of(cameras: Sequence[Camera], radii: Sequence[float]) -> Tensor:
    """(C, 4) float32: the centres of cameras, and a radius for each, in world units; on the CPU."""
    pairs = zip(cameras, radii, strict=True)
    return torch.tensor([[*c.position.tolist(), radius] for c, radius in pairs])
