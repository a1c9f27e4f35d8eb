"""Matches the features of pairs of photos, and verifies the matches, in the COLMAP database."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.sfm.colmap.database import closing_database, count_rows, match_counts, set_names
from snowsplat.sfm.colmap.features import SEED, WorkerProgress
from snowsplat.sfm.colmap.matching import LENGTH, match_descriptors
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.util import native_library

# Number of pairs that are matched or verified before the results are written to the database. If
# the process is killed, at most this many pairs have to be processed again. The progress increases
# in steps of this number.
_PAIRS_PER_BLOCK = 64

# Number of photos whose descriptors are kept in memory while pairs are matched.
_CACHED_PHOTOS = 100

# A verified pair has at least this many inliers: matches that are consistent with a relative pose.
_MIN_INLIERS = 15
# The pairs of a group are verified in this number of passes over all photos. Pairs with few inliers
# take several times as long as others. Each pass contains pairs of all kinds, so the time left can
# be estimated from the number of verified pairs.
_PASSES = 8
# Pairs are verified in groups. Each group has one of these smallest inlier ratios. The last ratio
# is the default of COLMAP; it is used for all pairs with many matches.
_INLIER_RATIOS = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.32, 0.25)
# The maximum number of samples of RANSAC (COLMAP: 10,000). It matters for pairs with many
# matches of which most are false, such as photos of a carpet that repeats. For 600 pairs of four
# real datasets, the result is the same as with 10,000.
_MAX_TRIALS = 3000


def match_pairs(
    database: Path, pairs: list[tuple[int, int]], threads: int, progress: WorkerProgress
) -> None:
    """Match those ``pairs`` (two indices of photos each) that have no matches in the database."""
    native_library.set_num_threads(threads)
    with closing_database(database) as opened:

        @functools.lru_cache(_CACHED_PHOTOS)
        def descriptors(index: int) -> NDArray[np.uint8]:
            if not opened.exists_descriptors(index + 1):
                return np.zeros((0, LENGTH), np.uint8)
            return np.asarray(opened.read_descriptors(index + 1).data).reshape(-1, LENGTH)

        remaining = [(i, j) for i, j in pairs if not opened.exists_matches(i + 1, j + 1)]
        for start in range(0, len(remaining), _PAIRS_PER_BLOCK):
            done = len(pairs) - len(remaining) + start
            progress.report(done, len(pairs), "matched pairs")
            transaction = pycolmap.DatabaseTransaction(opened)
            for i, j in remaining[start : start + _PAIRS_PER_BLOCK]:
                matches = match_descriptors(descriptors(i), descriptors(j))
                opened.write_matches(i + 1, j + 1, matches)
            del transaction  # the destructor ends the transaction


def verify_pairs(
    database: Path,
    photos: Sequence[Photo],
    pairs: list[tuple[int, int]],
    max_error: float,
    threads: int,
    progress: WorkerProgress,
) -> None:
    """Let COLMAP verify the matches of those ``pairs`` that are not verified yet.

    ``max_error`` is the largest distance of a verified match from its epipolar line, in pixels of
    the photos in ``input/``. The lenses are those in the database.
    """
    # COLMAP reads the pairs from a file in which spaces separate the names, and the name of a photo
    # may contain spaces. Therefore the images temporarily have numbers as names.
    set_names(database, [str(i) for i in range(len(photos))])
    table = "two_view_geometries"
    try:
        with _progress_of_rows(database, table, len(pairs), "verified pairs", progress):
            for ratio, group in _by_inlier_ratio(pairs, match_counts(database)).items():
                _verify(database, group, ratio, max_error, threads)
    finally:
        set_names(database, [photo.name for photo in photos])


def _by_inlier_ratio(
    pairs: list[tuple[int, int]], counts: dict[tuple[int, int], int]
) -> dict[float, list[tuple[int, int]]]:
    """The ``pairs``, grouped by the smallest inlier ratio that RANSAC has to find.

    ``counts`` is the number of matches of each pair. The number of samples in RANSAC depends on the
    smallest inlier ratio that it has to find. A pair with few matches and `_MIN_INLIERS` inliers
    has a high inlier ratio, so a few samples suffice to find the inliers or to reject the pair.
    """
    groups: dict[float, list[tuple[int, int]]] = {}
    for pair in pairs:
        least = _MIN_INLIERS / max(1, counts.get(pair, 0))
        ratio = next((ratio for ratio in _INLIER_RATIOS if ratio <= least), _INLIER_RATIOS[-1])
        groups.setdefault(ratio, []).append(pair)
    return groups


def _verify(
    database: Path,
    pairs: list[tuple[int, int]],
    inlier_ratio: float,
    max_error: float,
    threads: int,
) -> None:
    """Let COLMAP verify the matches of ``pairs``, which are in the database."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers = _MIN_INLIERS
    verification.ransac.min_inlier_ratio = inlier_ratio
    verification.ransac.max_num_trials = _MAX_TRIALS
    verification.ransac.max_error = max_error
    verification.ransac.random_seed = SEED
    pairing = pycolmap.ImportedPairingOptions()
    pairing.block_size = _PAIRS_PER_BLOCK
    pairing.match_list_path = database.with_suffix(".pairs")
    ordered = [pair for first in range(_PASSES) for pair in pairs[first::_PASSES]]
    Path(pairing.match_list_path).write_text("".join(f"{i} {j}\n" for i, j in ordered))
    try:
        pycolmap.match_image_pairs(
            database,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    finally:
        os.remove(pairing.match_list_path)


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
