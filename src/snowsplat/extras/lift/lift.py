"""`lift`: a photo and its depth map -> Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from snowsplat.extras.lift.blocks import merge_pixels, pixel_blocks
from snowsplat.extras.lift.colors import match_photo
from snowsplat.extras.lift.discs import discs, sigma_of_block
from snowsplat.extras.lift.edges import find_links, snap_to_surfaces
from snowsplat.extras.lift.options import LiftOptions
from snowsplat.extras.lift.surface import surface_of
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order
from snowsplat.util.process import single_threaded


def lift(
    photo: Tensor, depth: Tensor, camera: Camera, options: LiftOptions | None = None
) -> Gaussians:
    """The visible surface of a photo as flat Gaussians, in the world frame, of SH degree 0.

    Args:
        photo: (H, W, 3) float32 in 0..1.
        depth: (H, W) float32, camera z in world units, positive; NaN where it is unknown. There
            are no Gaussians for such pixels.
        camera: the camera of the photo, of size (W, H).

    Returns:
        The Gaussians in Morton order.

    Raises:
        ValueError: the sizes differ, or no depth is known.
    """
    options = options or LiftOptions()
    if photo.shape[:2] != depth.shape or (camera.height, camera.width) != depth.shape:
        raise ValueError(
            f"lift: the photo is {tuple(photo.shape[:2])}, the depth {tuple(depth.shape)}, the "
            f"camera {(camera.height, camera.width)}; they must be equal"
        )
    known = depth.isfinite() & (depth > 0)
    if not bool(known.any()):
        raise ValueError("lift: no pixel has a known depth")
    with single_threaded():
        return _lift(photo, torch.where(known, depth, torch.nan), camera, options)


def _lift(photo: Tensor, depth: Tensor, camera: Camera, options: LiftOptions) -> Gaussians:
    depth = snap_to_surfaces(depth, options.edge)
    known = depth.isfinite()
    links = find_links(depth, options.edge)
    surface = surface_of(depth, camera, links)
    if options.max_gaussians is None:
        blocks = pixel_blocks(known)
    else:
        blocks = merge_pixels(depth, photo, links, options.max_gaussians)
    gaussians = discs(
        blocks.mean(surface.points),
        blocks.mean(surface.tangents),
        blocks.mean(photo),
        camera,
        sigma=sigma_of_block(blocks.size),
    )
    # Pixels of unknown depth have no discs. Black, the background, leaves the others unchanged.
    known_photo = torch.where(known[..., None], photo, 0.0)
    gaussians = match_photo(gaussians, camera, known_photo)
    return gaussians.select(morton_order(gaussians.means))
