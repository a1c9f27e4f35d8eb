"""Detects features in the photos and matches them, into the COLMAP database."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.sfm.colmap.database import closing_database, count_rows, set_names, trim_features
from snowsplat.sfm.colmap.matching import LENGTH, match_descriptors
from snowsplat.sfm.colmap.options import Effort
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.progress import Report
from snowsplat.util import native_library

# Number of pairs that are processed before the results are written to the database. A kill loses at
# most this many pairs. The progress increases in steps of this number.
_PAIRS_PER_BLOCK = 64

# Number of photos whose descriptors are kept in memory while pairs are matched.
_CACHED_PHOTOS = 100

# A photo has at most this many times the requested number of features.
_MAX_FEATURE_FACTOR = 2

#: The seed of all random numbers in COLMAP.
SEED = 1


@dataclass(frozen=True)
class Folders:
    """Paths inside a dataset."""

    dataset: Path

    @property
    def images(self) -> Path:
        return self.dataset / "input"

    @property
    def distorted(self) -> Path:
        return self.dataset / "distorted"

    @property
    def masks(self) -> Path:
        return self.distorted / "masks"

    @property
    def database(self) -> Path:
        return self.distorted / "database.db"

    @property
    def sparse(self) -> Path:
        return self.distorted / "sparse"


@dataclass(frozen=True)
class WorkerProgress:
    """The functions with which the worker sends its progress to the parent process.

    ``report`` sends a number of finished items. ``watch`` names a table of the database: the parent
    process then counts the rows that COLMAP writes into it. The worker must not count them. COLMAP
    contains its own copy of SQLite, and two copies of SQLite in one process break each other's
    locks on a database that both have open.
    """

    report: Report
    watch: Callable[[str, str, int, str], None]  # database, table, final row count, item name


def extract_features(
    folders: Folders,
    database: Path,
    photos: list[Photo],
    effort: Effort,
    threads: int,
    progress: WorkerProgress,
) -> None:
    """Detect the features of photos that have none in ``database`` yet."""
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = effort.image_size
    options.num_threads = threads
    options.use_gpu = False
    options.sift.max_num_features = effort.features
    options.sift.first_octave = effort.first_octave
    with _counted(database, "keypoints", len(photos), "features", progress):
        # If a mask folder is set, COLMAP skips photos without a mask. They need a separate call.
        for masked in (False, True):
            names = [photo.name for photo in photos if photo.mask == masked]
            reader = pycolmap.ImageReaderOptions()
            if masked:
                reader.mask_path = folders.masks
            if names:
                pycolmap.extract_features(
                    database,
                    folders.images,
                    image_names=names,
                    camera_mode=pycolmap.CameraMode.PER_IMAGE,
                    reader_options=reader,
                    extraction_options=options,
                    device=pycolmap.Device.cpu,
                )
    trim_features(database, _MAX_FEATURE_FACTOR * effort.features)


def match_pairs(
    database: Path,
    photos: list[Photo],
    pairs: list[tuple[int, int]],
    max_error: float,
    threads: int,
    progress: WorkerProgress,
) -> None:
    """Match the features of those ``pairs`` that are not in the database yet.

    A pair consists of two indices of photos. ``max_error`` in pixels is the largest distance of a
    match from its epipolar line. COLMAP verifies the matches that it finds in the database.
    """
    _write_matches(database, pairs, threads, progress.report)
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = threads
    options.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.max_error = max_error
    verification.ransac.random_seed = SEED
    pairing = pycolmap.ImportedPairingOptions()
    pairing.block_size = _PAIRS_PER_BLOCK
    pairing.match_list_path = database.with_suffix(".pairs")
    # The file with the pairs separates names by blanks, and the name of a photo may contain blanks.
    # Therefore the images are temporarily named by numbers.
    set_names(database, [str(i) for i in range(len(photos))])
    Path(pairing.match_list_path).write_text("".join(f"{i} {j}\n" for i, j in pairs))
    try:
        with _counted(database, "two_view_geometries", len(pairs), "pairs", progress):
            pycolmap.match_image_pairs(
                database,
                matching_options=options,
                pairing_options=pairing,
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )
    finally:
        os.remove(pairing.match_list_path)
        set_names(database, [photo.name for photo in photos])


def _write_matches(path: Path, pairs: list[tuple[int, int]], threads: int, report: Report) -> None:
    """Write the matches of those ``pairs`` that have none in the database ``path``."""
    native_library.set_num_threads(threads)
    with closing_database(path) as database:

        @functools.lru_cache(_CACHED_PHOTOS)
        def descriptors(index: int) -> NDArray[np.uint8]:
            if not database.exists_descriptors(index + 1):
                return np.zeros((0, LENGTH), np.uint8)
            return np.asarray(database.read_descriptors(index + 1).data).reshape(-1, LENGTH)

        left = [(i, j) for i, j in pairs if not database.exists_matches(i + 1, j + 1)]
        for start in range(0, len(left), _PAIRS_PER_BLOCK):
            report(len(pairs) - len(left) + start, len(pairs), "compared pairs")
            transaction = pycolmap.DatabaseTransaction(database)
            for i, j in left[start : start + _PAIRS_PER_BLOCK]:
                matches = match_descriptors(descriptors(i), descriptors(j))
                database.write_matches(i + 1, j + 1, matches)
            del transaction  # ends it


@contextmanager
def _counted(
    database: Path, table: str, total: int, what: str, progress: WorkerProgress
) -> Iterator[None]:
    # COLMAP has the database open inside the with block; see `WorkerProgress`.
    progress.report(min(count_rows(database, table), total), total, what)
    progress.watch(str(database), table, total, what)
    yield
    progress.report(total, total, what)
