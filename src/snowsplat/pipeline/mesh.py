"""`write_mesh`: the surfaces of a scene as triangles or as dense points."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from snowsplat.data import ImageLoader, View
from snowsplat.formats import mesh_files
from snowsplat.pipeline.confirmed_depth import PHOTO_BYTES, confirm_by_photos
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.scene import MeshOptions
from snowsplat.pipeline.output.scene_source import TrainedScene
from snowsplat.scene.camera import Camera
from snowsplat.scene.mesh import Mesh, compact_mesh, filled_holes, largest_parts, vertex_normals
from snowsplat.scene.orientation import scene_up
from snowsplat.surface.colors import vertex_colors
from snowsplat.surface.depth import DepthMap, SurfaceRenderer
from snowsplat.surface.isosurface import zero_level
from snowsplat.surface.volume import Report, fuse_maps, occupied_blocks
from snowsplat.training.starts.photos import decoded_ahead, reduced_photo, usable_pixels
from snowsplat.util.errors import UserError
from snowsplat.util.files import check_target, make_parent
from snowsplat.util.process import single_threaded
from snowsplat.util.process_memory import return_unused

#: Memory: pixels of all depth maps, with 5 bytes each, and blocks of 512 voxels with 8 bytes each.
_MOST_PIXELS, _MOST_BLOCKS = 120_000_000, 100_000
#: The side of a voxel, in widths of a pixel at the usual depth.
_VOXEL_PIXELS = 2.0
#: The smallest side: no two photos agree where the surface is more exactly.
_SMALLEST_VOXEL = 0.2
#: Surfaces that are farther away than this multiple of the usual depth are cut.
_REACH = 3.0
#: A photo shows a vertex if its depth differs by less than this number of voxels.
_SAME_PLACE = 2.0
_TRANSPARENT = 16  # of 255: a pixel of a photo with less alpha shows nothing
_OPAQUE = (".jpg", ".jpeg")  # other photos can have transparent pixels
_SAMPLE_VIEWS = 32  # that determine the usual depth
_SAMPLE_STEP = 3  # of the pixels that determine it


@dataclass(frozen=True)
class Surface:
    """A mesh, and how it was made; lengths in world units."""

    mesh: Mesh
    photos: int
    voxel: float
    far: float
    found: int  # triangles before parts were removed and the mesh was simplified
    closer: bool  # whether memory has limited the voxels


def write_mesh(
    load: Callable[[], TrainedScene],
    target: Path,
    options: MeshOptions | None = None,
    overwrite: bool = False,
    observer: Observer = SILENT,
    *,
    points: bool = False,
) -> Surface:
    """Write the surfaces of a scene as triangles with the colours of the photos.

    The depth of each training photo is rendered, corrected where other photos confirm another depth
    (see `pipeline.confirmed_depth`), and fused into a signed distance field.

    Args:
        load: loads the scene with its dataset, as `load_trained`; called after the other
            arguments have been checked.
        target: .ply, .glb or .obj; with ``points``, .ply, .las or .laz, of which the last two need
            the packages laspy and lazrs. Its folder is created if it does not exist.
        overwrite: replace ``target``.
        observer: gets the stages "reading", "depth", "stereo", "fusion", "triangles" and
            "colours".
        points: write a dense cloud of points with normals and colours: the vertices, about one for
            each voxel of the surface.

    Raises:
        UserError: ``target`` exists or has another suffix; a photo is damaged; there is no surface,
            or a package for an option is missing.
        OSError: ``target`` cannot be written.
    """
    kinds = mesh_files.POINTS_SUFFIXES if points else mesh_files.MESH_SUFFIXES
    mesh_files.check_suffix(target, kinds)
    check_target(target, overwrite)
    with observer.waiting("reading"):
        scene = load()
    surface = surface_of(scene, options or MeshOptions(), observer)
    if points:
        surface = replace(surface, mesh=replace(surface.mesh, faces=surface.mesh.faces[:0]))
    make_parent(target)
    comments = [f"snowsplat: voxels of {surface.voxel:.4g} from {surface.photos} photos"]
    mesh_files.write_mesh(target, surface.mesh, comments)
    return surface


def surface_of(scene: TrainedScene, options: MeshOptions, observer: Observer = SILENT) -> Surface:
    """The surfaces of a scene; see `write_mesh`. Raises: UserError: there is no surface."""
    views = scene.dataset.train or scene.dataset.test
    with single_threaded():
        with observer.waiting("depth") as report:
            maps, far = _depth_maps(scene, views, options, report)
        return_unused()  # temporary tensors of the photos; here and after the next stages
        with observer.waiting("stereo") as report:
            confirm_by_photos(views, maps, far, report)
        return_unused()
        with observer.waiting("fusion") as report:
            voxel, keys, closer = _voxel(maps, options)
            if not len(keys):
                raise UserError(
                    "no surface is shown by two photos; train longer, or use a larger `far` or "
                    "`voxel`"
                )
            volume = fuse_maps(maps, voxel, keys, report)
        return_unused()
        with observer.waiting("triangles"):
            vertices, faces = zero_level(volume)
            del volume
            found = len(faces)
            vertices, faces = _cleaned(vertices, faces, options)
        return_unused()
        with observer.waiting("colours") as report:
            photos = _photos(views, maps, scene.gaussians.means.device, report)
            colors = vertex_colors(vertices, faces, photos, _SAME_PLACE * voxel)
    normals = vertex_normals(vertices, faces)
    poses = torch.stack([view.camera.cam_from_world[:, :3] for view in views])
    x, y, z = scene_up(poses.detach().double().cpu().numpy()).tolist()
    mesh = Mesh(vertices, faces, normals, colors, scene.dataset.origin, (x, y, z))
    return Surface(mesh, len(views), voxel, far, found, closer)


def _depth_maps(
    scene: TrainedScene, views: Sequence[View], options: MeshOptions, report: Report
) -> tuple[list[DepthMap], float]:
    """The depth map of each view, and the depth behind which there is no surface."""
    device = scene.gaussians.means.device
    renderer = SurfaceRenderer(scene.gaussians)
    pixels = sum(view.camera.width * view.camera.height for view in views)
    share = min(1.0, math.sqrt(_MOST_PIXELS / pixels))
    cameras = []
    for view in views:
        size = (max(1, int(share * side)) for side in (view.camera.width, view.camera.height))
        cameras.append(view.camera.scaled(*size).to(device))
    far = options.far
    if far is None:
        sample = cameras[:: math.ceil(len(cameras) / _SAMPLE_VIEWS)]
        far = _REACH * _usual_depth([renderer.render(_small(camera)) for camera in sample])
    partial = [
        view.mask is not None or view.image.path.suffix.lower() not in _OPAQUE for view in views
    ]
    widths = [camera.width for camera in compress(cameras, partial)]
    maps = []
    with ImageLoader(views, budget_bytes=PHOTO_BYTES) as loader:
        ahead = decoded_ahead(list(compress(views, partial)), widths, loader)
        for i, (camera, is_partial) in enumerate(zip(cameras, partial, strict=True)):
            report(i, len(cameras), "photos")
            found = renderer.render(camera, far)
            if is_partial:
                photo = reduced_photo(next(ahead), loader, camera.width, camera.height)
                empty = None if photo.alpha is None else photo.alpha < _TRANSPARENT
                found = found.corrected(empty, photo.mask)
            maps.append(found)
    return maps, far


def _small(camera: Camera) -> Camera:
    return camera.scaled(max(1, camera.width // 4), max(1, camera.height // 4))


def _usual_depth(maps: Sequence[DepthMap]) -> float:
    """The median, over views, of the median depth. Raises UserError: no view shows a surface."""
    medians = []
    for each in maps:
        sample = each.depth[::_SAMPLE_STEP, ::_SAMPLE_STEP]
        known = sample[sample.isfinite() & (sample > 0)]
        if len(known):
            medians.append(float(known.median()))
    if not medians:
        raise UserError("the photos show no surface; train longer, or use a larger `far`")
    return float(np.median(medians))


def _focal(maps: Sequence[DepthMap]) -> float:
    return float(np.median([each.camera.fx for each in maps]))


def _voxel(maps: Sequence[DepthMap], options: MeshOptions) -> tuple[float, np.ndarray, bool]:
    """The side of a voxel, the blocks near a surface, and whether memory has limited the former."""
    voxel = options.voxel
    if voxel is None:
        voxel = _VOXEL_PIXELS * _usual_depth(maps) / _focal(maps)
    elif voxel < _SMALLEST_VOXEL * (pixel := _usual_depth(maps) / _focal(maps)):
        raise UserError(
            "`voxel` is smaller than a fifth of a pixel of the photos; use at least {pixel:.3g}",
            pixel=_SMALLEST_VOXEL * pixel,
        )
    keys = occupied_blocks(maps, voxel)
    limited = False
    while len(keys) > _MOST_BLOCKS:
        if options.voxel is not None:
            raise UserError(
                "{keys:,} blocks of voxels of {voxel:g} do not fit into memory; use a larger "
                "`voxel`, or a smaller `far`",
                keys=len(keys),
                voxel=voxel,
            )
        voxel *= 1.05 * math.sqrt(len(keys) / _MOST_BLOCKS)  # blocks are along surfaces
        keys, limited = occupied_blocks(maps, voxel), True
    return voxel, keys, limited


def _cleaned(
    vertices: np.ndarray, faces: np.ndarray, options: MeshOptions
) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without small parts, with holes filled and simplified as the options say."""
    faces = faces[largest_parts(faces, len(vertices), options.parts)]
    vertices, faces, _ = compact_mesh(vertices, faces)
    if not len(faces):
        raise UserError("no surface was found; train longer, or use another `voxel`")
    if options.fill_holes:
        vertices, faces = filled_holes(vertices, faces)
    if options.triangles is not None and options.triangles < len(faces):
        import fast_simplification  # an optional package

        vertices, faces = fast_simplification.simplify(
            vertices, faces, target_count=options.triangles
        )
        vertices, faces = vertices.astype(np.float32), faces.astype(np.int32)
    return vertices, faces


def _photos(
    views: Sequence[View], maps: Sequence[DepthMap], device: torch.device, report: Report
) -> Iterator[tuple[DepthMap, Tensor, Tensor | None]]:
    """The depth maps with their photos at the same size."""
    widths = [each.camera.width for each in maps]
    with ImageLoader(views, budget_bytes=PHOTO_BYTES) as loader:
        ahead = decoded_ahead(views, widths, loader)
        for i, (view, each) in enumerate(zip(ahead, maps, strict=True)):
            report(i, len(views), "photos")
            photo = reduced_photo(view, loader, each.camera.width, each.camera.height)
            yield each, photo.planes[:3], usable_pixels(photo)
