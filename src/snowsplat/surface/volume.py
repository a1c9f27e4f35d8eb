"""Depth maps, fused into a truncated signed distance field in sparse blocks of voxels.

Only blocks near a surface have memory. They are found first, from all depth maps, so that every
view can say where a block is empty, whatever their order is (Curless and Levoy 1996; the blocks are
those of Nießner et al. 2013).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.scene.camera import Camera
from snowsplat.surface.depth import DepthMap

#: Called with the number of finished views, of all, and what they are.
Report = Callable[[int, int, str], None]

#: Voxels along each side of a block.
SIDE = 8
#: The distance at which the field is cut off, in voxels; half a block.
TRUNCATION = 4.0
_FEWEST_VIEWS = 2  # that show the surface in a block
_OFFSET = 1 << 20  # of the coordinates of a block, in its key of 3 × 21 bits


@dataclass
class Volume:
    """A signed distance field.

    Attributes:
        voxel: the distance of neighbouring samples, world units.
        keys: (B,) int64, ascending: the blocks; see `block_coordinates`.
        sums: (B, 8, 8, 8, 2) float32: Σ w and Σ w s of each voxel, with the indices z, y, x; s is
            the distance in front of the surface, divided by the truncation, at most 1.
    """

    voxel: float
    keys: np.ndarray
    sums: Tensor


def block_coordinates(keys: np.ndarray) -> np.ndarray:
    """(B, 3) int64: x, y, z of blocks in units of their side; block 0 begins at the origin."""
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, keys >> 21 & mask, keys & mask], 1) - _OFFSET


def block_keys(coordinates: np.ndarray) -> np.ndarray:
    """(B,) int64: the inverse of `block_coordinates`; coordinates are below 2²⁰."""
    x, y, z = (coordinates + _OFFSET).T
    return x << 42 | y << 21 | z


def to_image(camera: Camera, like: Tensor) -> Tensor:
    """(3, 4): K [R | t], for `ops.fuse_depth`."""
    pose = camera.cam_from_world
    return (camera.intrinsics.to(pose.device) @ pose.to(torch.float64)).to(like)


def occupied_blocks(maps: Sequence[DepthMap], voxel: float) -> np.ndarray:
    """(B,) int64, ascending: the keys of the blocks near a surface that two views show."""
    found = [_blocks_of(each, voxel) for each in maps]
    keys, views = np.unique(np.concatenate([np.zeros(0, np.int64), *found]), return_counts=True)
    return keys[views >= min(_FEWEST_VIEWS, len(maps))]


def _blocks_of(depth_map: DepthMap, voxel: float) -> np.ndarray:
    """The keys of the blocks within the truncation of the surface of a view, along its rays."""
    camera, side = depth_map.camera, SIDE * voxel
    known = depth_map.depth[depth_map.depth.isfinite() & (depth_map.depth > 0)]
    if not len(known):
        return np.zeros(0, np.int64)
    # Two rays per side of a block, at the depth that most pixels exceed.
    near = float(known[:: max(1, len(known) // 4096)].quantile(0.05))
    step = max(1, int(0.5 * side * min(camera.fx, camera.fy) / near))
    depth = depth_map.depth[::step, ::step]
    rows, columns = (depth.isfinite() & (depth > 0)).nonzero(as_tuple=True)
    z = depth[rows, columns].double()
    x, y = columns * step + 0.5 - camera.cx, rows * step + 0.5 - camera.cy
    rays = torch.stack([x / camera.fx, y / camera.fy, torch.ones_like(z)], 1)
    pose = camera.world_from_cam.to(rays)
    cells = []
    for offset in (-TRUNCATION, 0.0, TRUNCATION):
        points = (rays * (z + offset * voxel)[:, None]) @ pose[:, :3].T + pose[:, 3]
        cells.append((points / side).floor().to(torch.int64))
    cell = torch.cat(cells).cpu().numpy()
    return np.unique(block_keys(cell[(np.abs(cell) < _OFFSET).all(1)]))


def fuse_maps(maps: Sequence[DepthMap], voxel: float, keys: np.ndarray, report: Report) -> Volume:
    """The field of all depth maps in these blocks."""
    device = maps[0].depth.device
    sums = torch.zeros(len(keys), SIDE, SIDE, SIDE, 2, device=device)
    origins = torch.from_numpy(block_coordinates(keys) * (SIDE * voxel)).to(sums)
    for i, each in enumerate(maps):
        report(i, len(maps), "photos")
        projection = to_image(each.camera, sums)
        ops.fuse_depth(
            sums, origins, voxel, projection, each.depth, each.confidence, TRUNCATION * voxel
        )
    return Volume(voxel, keys, sums)
