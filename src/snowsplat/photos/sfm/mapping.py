"""From matches to cameras and points, and what is left when the badly fitting is taken away."""

from __future__ import annotations

import shutil
from pathlib import Path

import pycolmap

from snowsplat.photos.progress import Report
from snowsplat.photos.sfm.database import count_rows
from snowsplat.photos.sfm.features import SEED
from snowsplat.photos.sfm.options import Mapper

# A camera that sees fewer of the points is not held in its place by them.
MIN_POINTS = 15
MIN_PHOTOS = 3
# Pixels at which features were looked for: an observation further off is left out at the end.
_KEPT_ERROR = 3.0
_MIN_ANGLE = 1.5  # degrees between the rays of a point


def map_photos(
    database: Path,
    images: Path,
    mapper: Mapper,
    scale: float,
    relaxed: bool,
    threads: int,
    report: Report,
) -> list[pycolmap.Reconstruction]:
    """Find cameras and points; the models found, the one with most photos first.

    Args:
        scale: pixels of a photo to one at which its features were looked for (1 or more).
        relaxed: start and go on with weaker matches than is usual.
    """
    output = database.with_suffix(".models")
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir()
    try:
        if mapper == "global":
            found = _map_globally(database, images, output, scale, threads)
        else:
            found = _map_incrementally(database, images, output, scale, relaxed, threads, report)
    finally:
        shutil.rmtree(output, ignore_errors=True)
    return _usable([_refine(model, scale, threads) for model in found])


def _map_incrementally(
    database: Path,
    images: Path,
    output: Path,
    scale: float,
    relaxed: bool,
    threads: int,
    report: Report,
) -> list[pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = threads
    options.random_seed = SEED
    options.min_model_size = MIN_PHOTOS
    mapper, triangulation = options.mapper, options.triangulation
    mapper.init_max_error *= scale
    mapper.abs_pose_max_error *= scale
    mapper.filter_max_reproj_error *= scale
    triangulation.merge_max_reproj_error *= scale
    triangulation.complete_max_reproj_error *= scale
    if relaxed:
        options.min_num_matches = 10
        mapper.init_min_num_inliers = 40
        mapper.init_min_tri_angle = 6.0
        mapper.abs_pose_min_num_inliers = 15
        mapper.abs_pose_min_inlier_ratio = 0.15
        mapper.max_reg_trials = 6
    total = count_rows(database, "images")
    placed = 0

    def begin() -> None:
        nonlocal placed
        placed = 2
        report(placed, total, "photos placed")

    def step() -> None:
        nonlocal placed
        placed += 1
        report(min(placed, total), total, "photos placed")

    report(0, total, "photos placed")
    models = pycolmap.incremental_mapping(
        database,
        images,
        output,
        options,
        initial_image_pair_callback=begin,
        next_image_callback=step,
    )
    return list(models.values())


def _map_globally(
    database: Path, images: Path, output: Path, scale: float, threads: int
) -> list[pycolmap.Reconstruction]:
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = threads
    options.random_seed = SEED
    options.min_model_size = MIN_PHOTOS
    options.mapper.num_threads = threads
    options.mapper.random_seed = SEED
    options.mapper.max_normalized_reproj_error *= scale
    return list(pycolmap.global_mapping(database, images, output, options).values())


def _refine(model: pycolmap.Reconstruction, scale: float, threads: int) -> pycolmap.Reconstruction:
    """Leave out what fits badly, adjust all once more, and drop cameras that nothing holds."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = threads
    observations = pycolmap.ObservationManager(model)
    for _ in range(2):
        observations.filter_all_points3D(_KEPT_ERROR * scale, _MIN_ANGLE)
        for image_id in list(model.reg_image_ids()):
            image = model.image(image_id)
            if image.num_points3D < MIN_POINTS:
                observations.deregister_frame(image.frame_id)
        if model.num_reg_images() < MIN_PHOTOS:
            return model
        pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    return model


def _usable(models: list[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    # Largest first; one whose photos are all in a larger one says nothing new.
    kept: list[pycolmap.Reconstruction] = []
    placed: set[int] = set()
    for model in sorted(models, key=lambda m: (-m.num_reg_images(), -m.num_points3D())):
        photos = set(model.reg_image_ids())
        if len(photos) >= MIN_PHOTOS and len(photos - placed) > 0:
            kept.append(model)
            placed |= photos
    return kept


def write_models(models: list[pycolmap.Reconstruction], sparse: Path) -> None:
    """Write them as ``sparse/0``, ``sparse/1`` …: all or nothing."""
    temporary = sparse.with_name(f".{sparse.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    for number, model in enumerate(models):
        folder = temporary / str(number)
        folder.mkdir(parents=True)
        model.write(folder)
    shutil.rmtree(sparse, ignore_errors=True)
    temporary.rename(sparse)
