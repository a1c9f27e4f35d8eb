"""The ground of a scene: a coarse mesh to walk on, from depth maps of the views of its photos."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.mesh import compact_mesh, largest_parts, vertex_normals
from snowsplat.surface.depth import SurfaceRenderer
from snowsplat.surface.volume import fuse_maps, occupied_blocks, zero_level
from snowsplat.util.errors import UserError

#: The views that are rendered, and the longer side of each, in pixels.
_VIEWS, _SIDE = 100, 320
#: Relative to the median depth: a side of a voxel (8 cm for walls at 4 m; a person is 40 cm wide),
#: and the distance behind which there is no surface.
_VOXEL, _REACH = 1 / 50, 4.0
#: The least weight of a voxel: floors are seen at a grazing angle, and a hole is worse than a bump.
_LEAST_WEIGHT = 0.03
#: Parts with a smaller share of the triangles of the largest part are floaters.
_PARTS = 0.02
#: The cosine of the slope on which people stand: 37°.
_LEVEL = 0.8
#: The ground below a camera is at the median height of this number of its vertices, the nearest.
_NEAREST = 50
#: No photo shows all of a floor: below the mesh is a plane, at this quantile of the heights of the
#: level vertices, and this number of times as wide as the mesh.
_LOWEST, _WIDE = 0.02, 3.0


@dataclass(frozen=True)
class Ground:
    """Surfaces that stop a person, in the world frame of the scene.

    Attributes:
        vertices: (V, 3) float32.
        faces: (F, 3) int32, counter-clockwise from the side that is seen.
        eye_height: the median height of the cameras above the ground, in world units.
    """

    vertices: np.ndarray
    faces: np.ndarray
    eye_height: float


def ground_of(gaussians: Gaussians, cameras: Sequence[Camera], up: np.ndarray) -> Ground:
    """The surfaces that the photos show.

    Args:
        cameras: of the photos.
        up: (3,) float64, the unit vector in the world frame.

    Raises:
        UserError: there are no cameras, or they show no surface, or no ground.
    """
    if not cameras:
        raise UserError("`walk` needs the cameras of the photos; use the output folder of train")
    chosen = [camera.reduced(_SIDE) for camera in cameras[:: math.ceil(len(cameras) / _VIEWS)]]
    renderer = SurfaceRenderer(gaussians)
    maps = [renderer.render(camera) for camera in chosen]
    depths = [each.depth[each.depth.isfinite() & (each.depth > 0)] for each in maps]
    medians = [float(depth.median()) for depth in depths if len(depth)]
    if not medians:
        raise UserError("`walk`: the photos show no surface; leave it out, or train longer")
    usual = float(np.median(medians))
    maps = [each.corrected(each.depth > _REACH * usual, None) for each in maps]
    voxel = _VOXEL * usual
    keys = occupied_blocks(maps, voxel)
    volume = fuse_maps(maps, voxel, keys, lambda *_: None)
    vertices, faces = zero_level(volume, _LEAST_WEIGHT)
    faces = faces[largest_parts(faces, len(vertices), _PARTS)]
    vertices, faces, _ = compact_mesh(vertices, faces)
    level = vertices[vertex_normals(vertices, faces) @ up > _LEVEL]
    heights = [height for camera in chosen if (height := _height(camera, level, up)) is not None]
    if not heights:
        raise UserError("`walk`: no ground is below the photos; leave it out")
    corners, below = _plane(vertices, float(np.quantile(level @ up, _LOWEST)), up)
    faces = np.concatenate([faces, (below + len(vertices)).astype(faces.dtype)])
    return Ground(np.concatenate([vertices, corners]), faces, float(np.median(heights)))


def _plane(vertices: np.ndarray, height: float, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Four corners and two triangles of a level square below the vertices."""
    middle, extent = vertices.mean(0), np.ptp(vertices, axis=0).max()
    middle = middle + (height - middle @ up) * up
    right = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    right *= 0.5 * _WIDE * extent / np.linalg.norm(right)
    ahead = np.cross(up, right)
    corners = [middle + a * right + b * ahead for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    return np.array(corners, np.float32), np.array([[0, 1, 2], [0, 2, 3]])


def _height(camera: Camera, level: np.ndarray, up: np.ndarray) -> float | None:
    """The height of a camera above the nearest of the level vertices (V, 3) below; None: none."""
    towards = camera.position.double().cpu().numpy() - level
    above = towards @ up
    towards, above = towards[above > 0], above[above > 0]
    if len(above) < _NEAREST:
        return None
    aside = np.linalg.norm(towards - above[:, None] * up, axis=1)
    return float(np.median(above[np.argpartition(aside, _NEAREST - 1)[:_NEAREST]]))
