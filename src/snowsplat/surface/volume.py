"""Depth maps, fused into a truncated signed distance field in sparse blocks of voxels.

Only blocks near a surface have memory. They are found first, from all depth maps, so that every
view can say where a block is empty, whatever their order is (Curless and Levoy 1996; the blocks are
those of Nießner et al. 2013).

`zero_level` makes the triangles of its zero level: surface nets (Gibson 1998). A cell has eight
neighbouring voxels as its corners. Each cell in which the sign changes has one vertex, the mean of
the points at which the edges of the cell cross the level. Each edge between two voxels at which the
sign changes becomes a quad of the vertices of its four cells. The triangles are better shaped than
those of marching cubes, and half as many; no library has them for sparse blocks.
"""

import itertools
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
_CHUNK, _PARTS = 512, 8  # blocks at a time; parts of the edges of a kind
_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))  # (8, 3): z, y, x
#: Smallest sum of weights of a voxel: that of one view from the front that no other one confirms.
_LEAST_WEIGHT = 0.25


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


def zero_level(
    volume: Volume, least_weight: float = _LEAST_WEIGHT
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float32 in the world frame, and triangles (F, 3) int32, of the surface.

    Triangles are counter-clockwise from the side where the field is positive. Voxels whose weight
    is below ``least_weight`` have no surface.
    """
    # The keys of cells are those of `block_keys`, with coordinates in voxels.
    cells, places = [], []
    edges: list[list[np.ndarray]] = [[] for _ in range(6)]
    coordinates = block_coordinates(volume.keys)
    for start in range(0, len(coordinates), _CHUNK):
        own = coordinates[start : start + _CHUNK]
        field = _with_borders(volume, own, least_weight)
        with np.errstate(invalid="ignore"):
            negative, known = field < 0, np.isfinite(field)
        mixed, inside = np.zeros((2, len(own), SIDE, SIDE, SIDE), bool)
        inside[:] = True
        for corner in _CORNERS:
            mixed |= _shifted(negative, *corner)
            inside &= _shifted(negative, *corner)
        mixed &= ~inside
        for corner in _CORNERS:
            mixed &= _shifted(known, *corner)
        index = np.argwhere(mixed)
        base = SIDE * own[index[:, 0]]  # x, y, z
        corner = base + index[:, :0:-1]
        cells.append(block_keys(corner))
        places.append(_crossings(field, index) + corner.astype(np.float32))
        for axis in range(3):
            step = np.eye(3, dtype=int)[2 - axis]
            before, after = _shifted(negative, 0, 0, 0), _shifted(negative, *step)
            changes = (before != after) & _shifted(known, 0, 0, 0) & _shifted(known, *step)
            for inward in (False, True):
                index = np.argwhere(changes & (before == inward))
                first = SIDE * own[index[:, 0]] + index[:, :0:-1]
                edges[2 * axis + inward].append(block_keys(first))
    if not cells:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    vertices, keys = np.concatenate(places), np.concatenate(cells)
    firsts = [np.concatenate(each) for each in edges]
    del places, cells, edges  # 0.1 GB of a large scene
    faces = _quads(keys, firsts, vertices)
    return (volume.voxel * vertices).astype(np.float32), faces


def _with_borders(volume: Volume, own: np.ndarray, least_weight: float) -> np.ndarray:
    """(b, 9, 9, 9) float32: the field of some blocks and the next voxel on each axis; NaN: none."""
    field = np.full((len(own), SIDE + 1, SIDE + 1, SIDE + 1), np.nan, np.float32)
    for dz, dy, dx in _CORNERS:
        keys = block_keys(own + np.array([dx, dy, dz]))
        row = np.searchsorted(volume.keys, keys).clip(max=len(volume.keys) - 1)
        there = volume.keys[row] == keys
        to = tuple(slice(SIDE, None) if d else slice(0, SIDE) for d in (dz, dy, dx))
        of = tuple(slice(0, 1) if d else slice(None) for d in (dz, dy, dx))
        target = (there.nonzero()[0], *to)
        source = (torch.from_numpy(row[there]), *of)
        sums = volume.sums[source].cpu().numpy()
        weight = sums[..., 0]
        enough = weight >= least_weight
        values = np.where(enough, sums[..., 1] / np.where(enough, weight, 1), np.nan)
        field[target] = values
    return field


def _shifted(values: np.ndarray, dz: int, dy: int, dx: int) -> np.ndarray:
    """The values of the corner (dz, dy, dx) of each cell of (b, 9, 9, 9) samples: (b, 8, 8, 8)."""
    return values[:, dz : dz + SIDE, dy : dy + SIDE, dx : dx + SIDE]


def _crossings(field: np.ndarray, index: np.ndarray) -> np.ndarray:
    """(K, 3) float32: the mean crossing of the edges of cells (K, 4), x, y, z from the corner."""
    block, z, y, x = index.T
    values = {
        (dz, dy, dx): field[block, z + dz, y + dy, x + dx] for dz, dy, dx in _CORNERS.tolist()
    }
    total, count = np.zeros((3, len(index)), np.float32), np.zeros(len(index), np.float32)
    for corner, axis in itertools.product(values, range(3)):
        if corner[axis]:
            continue  # the edge begins at the other corner
        dz, dy, dx = (step + (other == axis) for other, step in enumerate(corner))
        a, b = values[corner], values[dz, dy, dx]
        crosses = (a < 0) != (b < 0)
        count += crosses
        total[axis] += np.where(crosses, a / np.where(crosses, a - b, 1), 0)
        for other in range(3):
            if corner[other]:
                total[other] += crosses
    return np.asarray((total / count)[::-1].T)


def _quads(cells: np.ndarray, edges: list[np.ndarray], vertices: np.ndarray) -> np.ndarray:
    """(F, 3) int32: two triangles for each edge whose four cells have a vertex.

    Args:
        cells: (V,), the key of the first corner of each cell.
        edges: six arrays of the keys of the first voxels of edges: along x where the field is
            positive there, along x where it is negative, and so on.
    """
    order = np.argsort(cells)
    ordered = cells[order]
    faces = np.empty((2 * sum(len(first) for first in edges), 3), np.int32)
    found = 0
    steps = np.array([1 << 42, 1 << 21, 1])  # of a key, along x, y and z
    for kind, part in itertools.product(range(6), range(_PARTS)):
        first = np.array_split(edges[kind], _PARTS)[part]
        axis, inward = divmod(kind, 2)
        b, c = steps[(axis + 1) % 3], steps[(axis + 2) % 3]
        quad = np.zeros((len(first), 4), np.int32)
        complete = np.ones(len(first), bool)
        for corner, step in enumerate((0, b, b + c, c)):
            row = np.searchsorted(ordered, first - step).clip(max=len(ordered) - 1)
            complete &= ordered[row] == first - step
            quad[:, corner] = order[row]
        quad = quad[complete]
        # Counter-clockwise about the axis; the outside is where the field is positive.
        if not inward:
            quad = quad[:, ::-1]
        p = vertices[quad]
        across = ((p[:, 0] - p[:, 2]) ** 2).sum(1) <= ((p[:, 1] - p[:, 3]) ** 2).sum(1)
        quad = np.where(across[:, None], quad, np.roll(quad, -1, 1))
        for corners in ([0, 1, 2], [0, 2, 3]):
            faces[found : found + len(quad)] = quad[:, corners]
            found += len(quad)
    return faces[:found]
