"""Detects features in the photos and writes them into the COLMAP database.

Towards the poles, a 360° panorama is stretched more and more, so its features are detected in
pinhole views of it. Their positions and shapes are those in the panorama.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.data.lens.models import lens_of
from snowsplat.data.lens.resample import resample
from snowsplat.data.lens.views import LensView, lens_views
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.colmap.database import closing_database
from snowsplat.sfm.colmap.features.sift import (
    Features,
    detect_in_grey,
    detect_sift,
    photos_at_once,
    read_grey,
    read_mask,
)
from snowsplat.sfm.colmap.options import Effort, detection_size, feature_count
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.progress import Report

#: The seed of all random numbers in COLMAP.
SEED = 1
# Radians. Nearer to a pole, an error of the position counts more than four times in the panorama.
_MAX_LATITUDE = np.radians(76.0)
_STEP = 0.5  # pixels of a view, for the derivative of the positions


@dataclass(frozen=True)
class WorkerProgress:
    """The functions with which the worker sends its progress to the parent process.

    ``report`` sends a number of finished items, ``show_poses`` is as `PoseMessages`.
    """

    report: Report
    show_poses: Callable[[pycolmap.Reconstruction, bool], None] = lambda model, now: None


def extract_features(
    dataset: DatasetFolder,
    database: Path,
    photos: list[Photo],
    effort: Effort,
    threads: int,
    progress: WorkerProgress,
) -> None:
    """Detect features in all photos that have none in ``database`` yet, and write them there."""

    def detect(photo: Photo) -> Features:
        mask = dataset.mask_of(photo.name) if photo.mask else None
        size = detection_size(effort.image_size, photo.panorama)
        count = feature_count(effort.features, photo.panorama)
        detect_in = detect_in_panorama if photo.panorama else detect_sift
        return detect_in(dataset.photos / photo.name, mask, size, count)

    at_once = photos_at_once(effort.image_size, threads)
    with closing_database(database) as opened, ThreadPoolExecutor(at_once) as pool:
        left = [i for i in range(len(photos)) if not opened.exists_descriptors(i + 1)]
        found = pool.map(detect, [photos[i] for i in left])
        for done, (i, features) in enumerate(zip(left, found, strict=True)):
            progress.report(len(photos) - len(left) + done, len(photos), "photos with features")
            opened.write_keypoints(i + 1, features.keypoints)
            sift = pycolmap.FeatureExtractorType.SIFT
            descriptors = pycolmap.FeatureDescriptors(sift, features.descriptors)
            opened.write_descriptors(i + 1, descriptors)
        progress.report(len(photos), len(photos), "photos with features")


def detect_in_panorama(photo: Path, mask: Path | None, image_size: int, count: int) -> Features:
    """The ``count`` largest features of a panorama, or fewer.

    Arguments and errors are those of `sift.detect_sift`; ``image_size`` is the width.
    """
    grey, (width, height) = read_grey(photo, image_size)
    allowed = None if mask is None else read_mask(mask, grey)
    rows, columns = grey.shape
    lens = lens_of("EQUIRECTANGULAR", columns, rows, (float(columns), float(rows)))
    parts = []
    for view in lens_views(lens):
        seen = _grey_in_view(grey, view)
        used = _own_part(view)
        if allowed is not None:
            used &= _grey_in_view(allowed, view) > 127
        if used.any():
            parts.append(_in_panorama(detect_in_grey(seen, used.astype(np.uint8), count), view))
    if not parts:
        return Features(np.zeros((0, 6), np.float32), np.zeros((0, 128), np.uint8))
    keypoints, descriptors = map(np.concatenate, zip(*parts, strict=True))
    area = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    latitude = (keypoints[:, 1] / lens.height - 0.5) * np.pi
    # The size is that on the sphere.
    largest = np.argsort(-area * np.cos(latitude), kind="stable")[:count]
    keypoints = keypoints[largest]
    stretch = np.array([width, height], np.float32) / grey.shape[::-1]
    keypoints[:, :2] *= stretch
    keypoints[:, 2:] *= stretch.mean()
    return Features(keypoints, descriptors[largest])


def _grey_in_view(grey: NDArray[np.uint8], view: LensView) -> NDArray[np.uint8]:
    """(h, w): a grey panorama (H, W) in a view."""
    return np.asarray(resample(grey[None], view, view.width, view.height)[0])


def _own_part(view: LensView) -> NDArray[np.bool_]:
    """(h, w): the pixels that are in no other view, and not near a pole."""
    fx, fy, cx, cy = view.params
    x, y = np.arange(view.width) + 0.5, np.arange(view.height) + 0.5
    inside = (np.abs(x - cx) <= fx) & (np.abs(y - cy) <= fy)[:, None]
    rays = view.rays(x, y)
    sine = np.abs(rays[..., 1]) / np.linalg.norm(rays, axis=-1)
    return np.asarray(inside & (sine < np.sin(_MAX_LATITUDE)))


def _in_panorama(found: Features, view: LensView) -> Features:
    """Features of a view, with their positions and shapes in the panorama."""
    made = found.keypoints.astype(np.float64)
    at = _positions(view, made[:, :2])
    columns = []
    for step in np.eye(2) * _STEP:
        moved = _positions(view, made[:, :2] + step) - at
        moved[:, 0] -= view.lens.width * np.round(moved[:, 0] / view.lens.width)
        columns.append(moved / _STEP)
    jacobian = np.stack(columns, -1)  # (N, 2, 2) panorama pixels for a pixel of the view
    made[:, 2:] = (jacobian @ made[:, 2:].reshape(-1, 2, 2)).reshape(-1, 4)
    made[:, :2] = at
    return Features(made.astype(np.float32), found.descriptors)


def _positions(view: LensView, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 2) in the panorama, of ``pixels`` (N, 2) of a view."""
    fx, fy, cx, cy = view.params
    rays = np.column_stack([(pixels - (cx, cy)) / (fx, fy), np.ones(len(pixels))])
    return view.lens.project(rays @ np.array(view.rotation))
