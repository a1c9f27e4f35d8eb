"""Detects features in the photos and writes them into the COLMAP database."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.colmap.database import closing_database
from snowsplat.sfm.colmap.features.panorama import detect_in_panorama
from snowsplat.sfm.colmap.features.sift import Features, detect_sift, photos_at_once
from snowsplat.sfm.colmap.options import Effort, detection_size, feature_count
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.progress import Report

#: The seed of all random numbers in COLMAP.
SEED = 1


@dataclass(frozen=True)
class WorkerProgress:
    """The functions with which the worker sends its progress to the parent process.

    ``report`` sends a number of finished items. ``features`` is called with the mean number of
    features of the photos, ``show_poses`` as `PoseMessages`.
    """

    report: Report
    features: Callable[[float], None] = lambda mean: None
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
        counts = []
        left = [i for i in range(len(photos)) if not opened.exists_descriptors(i + 1)]
        found = pool.map(detect, [photos[i] for i in left])
        for done, (i, features) in enumerate(zip(left, found, strict=True)):
            progress.report(len(photos) - len(left) + done, len(photos), "photos with features")
            counts.append(len(features.descriptors))
            transaction = pycolmap.DatabaseTransaction(opened)
            opened.write_keypoints(i + 1, features.keypoints)
            sift = pycolmap.FeatureExtractorType.SIFT
            descriptors = pycolmap.FeatureDescriptors(sift, features.descriptors)
            opened.write_descriptors(i + 1, descriptors)
            del transaction  # ends it
        if counts:
            progress.features(sum(counts) / len(counts))
        progress.report(len(photos), len(photos), "photos with features")
