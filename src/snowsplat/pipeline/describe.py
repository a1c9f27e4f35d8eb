"""`describe`: what a file or folder contains."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from snowsplat.data.photos.suffixes import PHOTO_SUFFIXES, VIDEO_SUFFIXES
from snowsplat.data.points_ply import read_points
from snowsplat.formats import Format, GaussianArrays, ply
from snowsplat.formats.lod import LEVELS, read_index
from snowsplat.formats.registry import UnknownFormatError
from snowsplat.pipeline.output.scene_files import format_for_reading, read_arrays
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.project.left_out import LeftOut
from snowsplat.project.project import Project
from snowsplat.scene.sh_constants import SH_REST_COUNTS
from snowsplat.sfm.ingest.search.archive import files_in, is_zip
from snowsplat.training.core import checkpoint
from snowsplat.util.errors import UserError
from snowsplat.util.ply import open_table

_ROOT_OF_SOG = "meta.json"  # the file that a zip file with a scene has
_PERCENTILES = (1, 50, 99)


def describe(path: Path | str) -> dict[str, Any]:
    """What the file or folder ``path`` contains, as a JSON object.

    The key "kind" has one of these values; the other keys depend on it:

    - "scene": format, number of Gaussians, bounds, and percentiles of opacity and scale. ``path``
      may also be a folder with a `lod-meta.json` or a SOG `meta.json`.
    - "point cloud": number of points, bounds.
    - "checkpoint": step, configuration, shapes of the tensors. The checksums are verified.
    - "output folder": dataset, scenes, checkpoints, metrics, the photos that were left out with the
      reasons, and a description of the last scene.
      ``path`` is the output folder of `train` or of `make`.
    - "zip file": number of photos and videos.
    - "photos" or "video": what `sfm` and `make` would use of it; see `describe_photos`.
    - "dataset": number and sizes of the photos, focal lengths, number of points, extent, and
      what is impossible or doubtful about the cameras.

    Bounds and lengths are in world units, in the frame of the file, relative to the "origin" of a
    scene or dataset that has one (`scene.origin`). "metres_per_unit" is the true scale, if it is
    known. torch is imported only where it is needed.

    Raises:
        UserError: ``path`` is missing, damaged, or of an unknown kind.
    """
    path = Path(path)
    if not path.exists():
        raise UserError("{path}: no such file or folder", path=path)
    if not (path.is_file() or path.is_dir()):  # reading it may never end
        raise UserError("{path}: is a pipe or a device; use a file", path=path)
    if path.suffix == ".safetensors":
        return _checkpoint(path)
    project = Project.open(path)
    path = project.scene_file() if project.is_file else path
    if is_zip(path) and _has_photos(path):
        return _zip(path)
    if path.is_file():
        try:
            format = format_for_reading(path)
        except UserError as error:
            if (unknown := _no_dataset(path, error)) is not None:
                return _photos(path, unknown)
        else:
            return _scene(path, format)
    if path.is_dir():  # a file may be a dataset
        training = project.training_folder()
        if training.is_training() or training.scenes():
            return _output(project)
    return _dataset(path)


def _scene(path: Path, format: Format) -> dict[str, Any]:
    facts: dict[str, Any] = {"file": str(path), "bytes": format.size(path)}
    if format.name == LEVELS:
        facts["gaussians_per_level"] = read_index(path).counts()
    if format.name == "PLY":
        table = open_table(path)
        facts["encoding"] = table.format
        if not ply.is_scene(table):
            xyz, _ = read_points(path)
            return {"kind": "point cloud", **facts, "points": len(xyz), **_bounds(xyz)}
    gaussians = read_arrays(path)
    version = f" {format.version(path)}" if format.version else ""
    facts |= {"format": format.name + version, "lost_in_it": format.loses}
    return {"kind": "scene", **facts, **_gaussians(gaussians)}


def _gaussians(gaussians: GaussianArrays) -> dict[str, Any]:
    usable = gaussians.select(gaussians.usable_rows())
    count, usable_count = len(gaussians.means), len(usable.means)
    facts: dict[str, Any] = {
        "gaussians": count,
        "sh_degree": SH_REST_COUNTS.index(gaussians.sh_rest.shape[1]),
        "antialiased": gaussians.antialiased,
        "bytes_in_memory": sum(array.nbytes for array in gaussians),
    }
    if any(gaussians.origin):
        facts["origin"] = list(gaussians.origin)
    if gaussians.metres_per_unit:
        facts["metres_per_unit"] = gaussians.metres_per_unit
    if usable_count < count:
        facts["not_finite"] = count - usable_count
    if usable_count:
        with np.errstate(over="ignore"):
            opacities = 1 / (1 + np.exp(-usable.opacity_logits))
            scales = np.exp(usable.log_scales)
        facts |= _bounds(usable.means)
        facts["opacity"] = _percentiles(opacities)
        facts["scale"] = _percentiles(scales.max(1))
        ratio = scales.max(1) / scales.min(1).clip(1e-12)
        facts["longest_to_shortest_axis"] = _percentiles(ratio)
    return facts


def _bounds(xyz: np.ndarray) -> dict[str, Any]:
    xyz = xyz[np.isfinite(xyz).all(1)]
    if not len(xyz):
        return {}
    low, high = np.percentile(xyz, [1, 99], axis=0)
    return {
        "bounds": [_rounded(xyz.min(0)), _rounded(xyz.max(0))],
        "bounds_of_98_percent": [_rounded(low), _rounded(high)],
    }


def _percentiles(values: np.ndarray) -> dict[str, float]:
    found = np.percentile(values, _PERCENTILES)
    return {f"p{p}": float(f"{v:.4g}") for p, v in zip(_PERCENTILES, found, strict=True)}


def _rounded(values: Any) -> list[float]:
    """The values with five significant digits."""
    return [float(f"{float(v):.5g}") for v in values]


def _checkpoint(path: Path) -> dict[str, Any]:
    content = checkpoint.load(path)
    return {
        "kind": "checkpoint",
        "file": str(path),
        "bytes": path.stat().st_size,
        "step": content.step,
        **content.meta,
        "tensors": {name: list(array.shape) for name, array in content.arrays.items()},
    }


def _output(project: Project) -> dict[str, Any]:
    folder = project.training_folder()
    facts: dict[str, Any] = {"kind": "output folder", "path": str(folder.path)}
    if folder.is_training():
        settings, background = folder.settings()
        facts["dataset"] = settings.path
        facts["background"] = list(background)
    facts["scenes"] = folder.scenes()
    if folder.checkpoints.is_dir():
        facts["checkpoints"] = sorted(p.name for p in folder.checkpoints.glob("step_*.safetensors"))
    if folder.metrics.is_file():
        metrics = folder.read_metrics()
        if not metrics:
            raise UserError("{metrics}: damaged; it is not JSON", metrics=folder.metrics)
        facts["metrics"] = {name: v for name, v in metrics.items() if name != "views"}
    facts |= _left_out(project.left_out)
    if facts["scenes"]:
        facts["last_scene"] = describe(project.scene_file())
    return facts


def _left_out(found: Sequence[LeftOut]) -> dict[str, Any]:
    """The photos that are not used, with the reasons; nothing if there are none."""
    return {"left_out": [vars(each) for each in found]} if found else {}


def _photos(path: Path, otherwise: UserError) -> dict[str, Any]:
    """What `describe_photos` says. Raises ``otherwise`` if there are no photos and no videos."""
    from snowsplat.pipeline.describe_photos import describe_photos  # pycolmap and torch
    from snowsplat.sfm.ingest.search.sources import NothingFoundError, find_sources

    try:
        sources = find_sources([path])
    except NothingFoundError:
        raise otherwise from None
    return describe_photos(sources)


def _has_photos(path: Path) -> bool:
    """Whether a zip file has photos or videos, and is not a SOG scene."""
    names = files_in(path)
    if any(name.endswith(_ROOT_OF_SOG) for name in names):
        return False
    suffixes = {PurePosixPath(name).suffix.lower() for name in names}
    return bool(suffixes & (PHOTO_SUFFIXES | VIDEO_SUFFIXES))


def _zip(path: Path) -> dict[str, Any]:
    """The scene in a zip file that may also have pictures of it; otherwise, its photos."""
    from snowsplat.pipeline.describe_photos import describe_zip  # pycolmap and torch

    try:
        return _scene(path, format_for_reading(path))
    except UserError:
        return describe_zip(path)


def _no_dataset(path: Path, error: UserError) -> UserError | None:
    """What to do with a file that is no scene; None: it may be a dataset."""
    from snowsplat.data.readers import advice, is_export  # torch

    if path.suffix == ".json" or is_export(path):
        return None
    if (known := advice(path)) is not None:
        return UserError("{path}: {known}", path=path, known=known)
    if not isinstance(error, UnknownFormatError):
        return error
    return UserError("{error}, checkpoints, datasets, photos and videos", error=error)


def _dataset(path: Path) -> dict[str, Any]:
    from snowsplat.data import load_dataset  # torch; the other kinds do not need it
    from snowsplat.data.judge.verdict import judge
    from snowsplat.data.readers import NoPosesError

    try:
        dataset = load_dataset(path)
    except NoPosesError as no_poses:
        return _photos(path, no_poses)
    views = [*dataset.train, *dataset.test]
    findings = judge(dataset)
    sizes = Counter(f"{view.camera.width}x{view.camera.height}" for view in views)
    focal = sorted(view.camera.fx for view in views)
    return {
        "kind": "dataset",
        "path": str(path),
        "description": dataset.description,
        "photos": len(views),
        "held_out_with_eval": len(dataset.test),
        "sizes": dict(sizes),
        "focal_length_pixels": _rounded([focal[0], focal[-1]]),
        "masks": sum(view.mask is not None for view in views),
        "depth_maps": sum(view.depth is not None for view in views),
        "normal_maps": sum(view.normals is not None for view in views),
        "points": 0 if dataset.points is None else len(dataset.points),
        "extent": float(f"{dataset.extent:.5g}"),
        **({"origin": list(dataset.origin)} if any(dataset.origin) else {}),
        **({"metres_per_unit": metres} if (metres := dataset.metres_per_unit) else {}),
        "bounds": [_rounded(corner) for corner in dataset.bounds.tolist()],
        "impossible": [finding.sentence for finding in findings if finding.impossible],
        "doubtful": [finding.sentence for finding in findings if not finding.impossible],
        **_left_out(DatasetFolder(path).left_out()),
    }
