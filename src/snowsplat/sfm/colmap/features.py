"""Detects features in the photos, matches them, and writes both into the COLMAP database."""

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

# Number of pairs that are matched or verified before the results are written to the database. If
# the process is killed, at most this many pairs have to be processed again. The progress increases
# in steps of this number.
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

    ``report`` sends a number of finished items. ``watch`` sends the name of a table of the
    database: the parent process then counts the rows that COLMAP writes into this table. The worker
    must not count them itself: COLMAP contains its own copy of SQLite, and if two copies of SQLite
    in one process have a database open, each removes the locks of the other.
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
    """Detect features in all photos that have none in ``database`` yet, and write them there."""
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = effort.image_size
    options.num_threads = threads
    options.use_gpu = False
    options.sift.max_num_features = effort.features
    options.sift.first_octave = effort.first_octave
    with _progress_of_rows(database, "keypoints", len(photos), "photos with features", progress):
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
    """Match and verify those ``pairs`` that are not in the database yet.

    A pair consists of two indices of photos. The matches are written to the database first, and
    COLMAP then only verifies them. ``max_error`` is the largest distance of a verified match from
    its epipolar line, in pixels of the photos in ``input/``.
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
    # COLMAP reads the pairs from a file in which spaces separate the names, and the name of a photo
    # may contain spaces. Therefore the images temporarily have numbers as names.
    set_names(database, [str(i) for i in range(len(photos))])
    Path(pairing.match_list_path).write_text("".join(f"{i} {j}\n" for i, j in pairs))
    try:
        table = "two_view_geometries"
        with _progress_of_rows(database, table, len(pairs), "verified pairs", progress):
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

        remaining = [(i, j) for i, j in pairs if not database.exists_matches(i + 1, j + 1)]
        for start in range(0, len(remaining), _PAIRS_PER_BLOCK):
            report(len(pairs) - len(remaining) + start, len(pairs), "matched pairs")
            transaction = pycolmap.DatabaseTransaction(database)
            for i, j in remaining[start : start + _PAIRS_PER_BLOCK]:
                matches = match_descriptors(descriptors(i), descriptors(j))
                database.write_matches(i + 1, j + 1, matches)
            del transaction  # the destructor ends the transaction


@contextmanager
def _progress_of_rows(
    database: Path, table: str, total: int, what: str, progress: WorkerProgress
) -> Iterator[None]:
    """Report the number of rows of a table while COLMAP writes them, inside the with block."""
    # The rows can be counted here only before COLMAP opens the database; see `WorkerProgress`.
    progress.report(min(count_rows(database, table), total), total, what)
    progress.watch(str(database), table, total, what)
    yield
    progress.report(total, total, what)
