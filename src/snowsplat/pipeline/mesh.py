"""`write_mesh`: the surfaces of a scene as triangles or as dense points.

A training makes images like the photos, and many arrangements of Gaussians do. On a wall with
little texture, they are in front of the wall, because those in front hide those behind. A plane
sweep compares the photos themselves: each pixel gets the depth at which a window of one photo
correlates best with others. Where the map of another photo has the same depth, this depth
replaces that of the Gaussians; where the two agree, their mean does, because their errors are not
the same. Elsewhere, for example on a wall of one colour, the depth of the Gaussians remains, and
has less weight.

Neighbouring Gaussians have about the same error: on an opaque object, what is behind the first ones
costs nothing, and the median lies behind the surface. So the mean difference of the two depths
around a pixel is first subtracted from the depth of the Gaussians, confirmed or not.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, avg_pool2d, interpolate

from snowsplat.data import ImageLoader, View
from snowsplat.formats import mesh_files
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.scene import MeshOptions
from snowsplat.pipeline.output.scene_source import TrainedScene
from snowsplat.scene.mesh import Mesh, compact_mesh, filled_holes, largest_parts, vertex_normals
from snowsplat.scene.orientation import scene_up
from snowsplat.surface.colors import vertex_colors
from snowsplat.surface.depth import DepthMap, SurfaceRenderer
from snowsplat.surface.volume import Report, fuse_maps, occupied_blocks, zero_level
from snowsplat.training.starts.depth_map import LONGER_SIDE
from snowsplat.training.starts.fusion import confirmed_pixels
from snowsplat.training.starts.photos import decoded_ahead, reduced_photo, usable_pixels
from snowsplat.training.starts.plane_sweep import Picture, depth_ranges, swept_maps
from snowsplat.training.starts.source_views import source_views
from snowsplat.util.errors import UserError
from snowsplat.util.files import check_target, make_parent
from snowsplat.util.image_size import scaled_size
from snowsplat.util.machine import return_unused
from snowsplat.util.process import single_threaded

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
#: All maps of a sweep together have at most this number of pixels, of nine bytes.
_MOST_SWEPT = 24_000_000
#: Each sweep has half the size of the one before, so larger windows: faint texture suffices.
_SWEEPS = 2
#: For photos that are decoded ahead; each is used once.
PHOTO_BYTES = 32 << 20
#: Each map is checked with those of this number of other views.
_SOURCES = 4
#: Points of the scene: with the first number, other views are chosen; with the second, the range
#: of the depths of a view.
_SAMPLE, _POINTS = 300, 10_000
#: The two depths agree if they differ by less than this share.
_AGREE = 0.03
#: The mean difference is that of 3×3 cells, each this share of the longer side of the map; the two
#: depths agree in at least the second share of the pixels there.
_CELL, _FEWEST = 1 / 40, 0.05
#: Of 255: the least weight of a depth that photos confirm.
_CONFIRMED = 128
#: The factor of the weight of all others.
_UNCONFIRMED = 0.25
#: The depths of two neighbouring pixels are those of one surface if an interpolated depth differs
#: by less than this share from the nearest one.
_SMOOTH = 0.01


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
        target: .ply, .glb, .obj or .usdz; with ``points``, .ply, .las or .laz. The last of each
            need packages. Its folder is created if it does not exist.
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
        if not options.gaussians_only:
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
    about = scene.dataset.origin, (x, y, z), scene.gaussians.metres_per_unit
    mesh = Mesh(vertices, faces, normals, colors, *about)
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
        far = _REACH * _usual_depth([renderer.render(camera.downscaled(4)) for camera in sample])
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


def _voxel(maps: Sequence[DepthMap], options: MeshOptions) -> tuple[float, np.ndarray, bool]:
    """The side of a voxel, the blocks near a surface, and whether memory has limited the former."""
    pixel = _usual_depth(maps) / float(np.median([each.camera.fx for each in maps]))
    voxel = options.voxel or _VOXEL_PIXELS * pixel
    if voxel < _SMALLEST_VOXEL * pixel:
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


def confirm_by_photos(
    views: Sequence[View], maps: Sequence[DepthMap], far: float, report: Report
) -> None:
    """Corrects maps, in place, by the depths that two photos confirm.

    Pixels that show no surface, and views that share no surface with others, remain as they are.

    Args:
        maps: of each view.
        far: farther away, in world units, there is no surface.

    Raises:
        UserError: a photo is damaged.
    """
    points = _points_of(maps)
    sample = points[:: math.ceil(max(1, len(points)) / _SAMPLE)]
    sources = source_views([view.camera for view in views], sample, _SOURCES)
    ranges = depth_ranges(views, points)
    pictures = _pictures(views, report)
    return_unused()
    found: list[Tensor | None] = [None] * len(maps)  # (h, w) inverse depths; 0: not confirmed
    for number in range(_SWEEPS):
        report(number, _SWEEPS, "comparisons of photos")
        swept = swept_maps(pictures, ranges, sources)
        for i, known in enumerate(confirmed_pixels(swept, sources, points.device)):
            each, finer = swept[i], found[i]
            if each is not None:
                inverse = each.inverse_depth.masked_fill_(~known, 0.0)  # not used again
                if finer is not None:
                    inverse = torch.where(finer > 0, finer, _enlarged(inverse, finer.shape))
                found[i] = inverse
        del swept
        pictures = [picture.half for picture in pictures]
    for i, inverse_depth in enumerate(found):
        if inverse_depth is not None:
            _correct(maps[i], inverse_depth, far)


def _pictures(views: Sequence[View], report: Report) -> list[Picture]:
    """The photos at the size of the first sweep."""
    pixels = sum(view.camera.width * view.camera.height for view in views)
    longest = max(max(view.camera.width, view.camera.height) for view in views)
    side = min(LONGER_SIDE, max(1, int(longest * min(1.0, math.sqrt(_MOST_SWEPT / pixels)))))
    widths = [scaled_size(view.camera.width, view.camera.height, side)[0] for view in views]
    found = []
    with ImageLoader(views, budget_bytes=PHOTO_BYTES) as loader:
        for i, view in enumerate(decoded_ahead(views, widths, loader)):
            report(i, len(views), "photos")
            found.append(Picture.from_view(view, loader, side))
    return found


def _points_of(maps: Sequence[DepthMap]) -> Tensor:
    """(P, 3) float64 on the CPU, world frame: points on the surfaces of all maps."""
    random = torch.Generator().manual_seed(0)
    count, found = math.ceil(_POINTS / len(maps)), []
    for each in maps:
        height, width = each.depth.shape
        rows, columns = (
            torch.randint(size, (count,), generator=random) for size in (height, width)
        )
        z = each.depth.cpu()[rows, columns].double()
        x = (columns + 0.5 - each.camera.cx) / each.camera.fx
        y = (rows + 0.5 - each.camera.cy) / each.camera.fy
        pose = each.camera.world_from_cam.cpu().double()
        points = (torch.stack([x, y, torch.ones_like(x)], 1) * z[:, None]) @ pose[:, :3].T
        found.append((points + pose[:, 3])[z.isfinite() & (z > 0)])
    return torch.cat(found)


def _correct(each: DepthMap, inverse: Tensor, far: float) -> None:
    """Corrects a map by the confirmed inverse depths (h, w); 0: not confirmed."""
    inverse = _enlarged(inverse, each.depth.shape).to(each.depth.device)
    surface = each.depth.isfinite()
    known = surface & (inverse * far > 1.0)
    swept = 1.0 / inverse
    agree = (each.depth / swept - 1.0).abs() < _AGREE
    own = each.depth * torch.exp(-_difference(each.depth, swept, known & agree))
    swept = torch.where(agree, 0.5 * (swept + own), swept)
    doubtful = (_UNCONFIRMED * each.weight).ceil().to(torch.uint8)
    weight = torch.where(surface, doubtful, each.weight)
    each.weight.copy_(torch.where(known, each.weight.clamp(min=_CONFIRMED), weight))
    each.depth.copy_(torch.where(known, swept, own))


def _difference(depth: Tensor, swept: Tensor, agree: Tensor) -> Tensor:
    """(H, W): the logarithm of depth / swept, mean of the pixels around that agree; 0: too few."""
    ratio = torch.where(agree, (depth / swept).log(), 0.0)
    height, width = depth.shape
    cell = max(1, round(_CELL * max(height, width)))
    grid = math.ceil(height / cell), math.ceil(width / cell)
    shares = adaptive_avg_pool2d(torch.stack([agree.to(ratio), ratio])[None], grid)
    share, total = avg_pool2d(shares, 3, stride=1, padding=1)[0]
    mean = torch.where(share >= _FEWEST, total / share, 0.0)
    return interpolate(mean[None, None], list(depth.shape), mode="bilinear")[0, 0]


def _enlarged(inverse: Tensor, size: Sequence[int]) -> Tensor:
    """(h, w) at another size; 0 at the edges of surfaces, and where the values are 0."""
    if inverse.shape == size:
        return inverse
    known = torch.where(inverse > 0, inverse, torch.nan)[None, None]
    smooth = interpolate(known, list(size), mode="bilinear")[0, 0]
    nearest = interpolate(known, list(size), mode="nearest-exact")[0, 0]
    return torch.where((smooth / nearest - 1.0).abs() < _SMOOTH, smooth, 0.0)
