"""Matches the features of pairs of photos, and verifies the matches, in the COLMAP database."""

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from snowsplat.scene.epipolar import sampson_distances
from snowsplat.sfm.colmap.database import MIN_INLIERS, closing_database
from snowsplat.sfm.colmap.features.extraction import SEED, WorkerProgress
from snowsplat.sfm.colmap.pairs.guided_matching import SAMPLE, PhotoSide, match
from snowsplat.sfm.colmap.pairs.matching import LENGTH
from snowsplat.util import native_library

# Number of pairs that are matched or verified before the results are written to the database. If
# the process is killed, at most this many pairs have to be processed again. The progress increases
# in steps of this number.
_PAIRS_PER_BLOCK = 64

# Number of photos whose descriptors are kept in memory while pairs are matched.
_CACHED_PHOTOS = 100

# RANSAC looks for at least one of these shares of inliers, the smallest with `MIN_INLIERS` of the
# matches of a pair. The last one is the default of COLMAP; it is used for pairs with many matches.
_INLIER_RATIOS = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.32, 0.25)
# The maximum number of samples of RANSAC (COLMAP: 10,000). It matters for pairs with many
# matches of which most are false, such as photos of a carpet that repeats. For 600 pairs of four
# real datasets, the result is the same as with 10,000.
_MAX_TRIALS = 3000
# Pairs with fewer matches are verified in one step: none of their matches can be spared.
_FEW = 100
# If more than this share of a sample of the matches agrees with a model, it is that of all.
_MOST = 0.5
# The kind of a pair is found among matches that agree with one model already: at least this share
# of them agrees with the right kind of model, and this number of them is enough.
_AGREEING, _ENOUGH, _FEWEST_TRIALS = 0.75, 200, 30
# If a smaller share of these agrees with a homography, they are not those of a plane, of photos
# from one place, or of a logo in the photos.
_FLAT = 0.7

_KINDS = pycolmap.TwoViewGeometryConfiguration
_USUAL = [  # not the photos of one watermark, and not those without any relative pose
    getattr(_KINDS, name).value
    for name in ("CALIBRATED", "UNCALIBRATED", "PLANAR", "PANORAMIC", "PLANAR_OR_PANORAMIC")
]
_Floats = NDArray[np.floating[Any]]
#: The camera of a photo, and (N, 2) the positions of its features in pixels of the photo.
Side = tuple[pycolmap.Camera, _Floats]


def match_pairs(
    database: Path,
    pairs: list[tuple[int, int]],
    max_error: float,
    threads: int,
    progress: WorkerProgress,
) -> None:
    """Match those ``pairs`` (two indices of photos each) that have no matches in the database.

    ``max_error`` as in `verify_matches`.
    """
    native_library.set_num_threads(1)  # pairs are matched at the same time
    with closing_database(database) as opened, ThreadPoolExecutor(threads) as pool:
        cameras = _cameras(opened)
        alike: dict[int, NDArray[np.int32]] = {}

        @functools.lru_cache(_CACHED_PHOTOS)
        def read_features(image: int) -> PhotoSide:
            if not opened.exists_descriptors(image):
                return PhotoSide(cameras[image], np.zeros((0, 2)), np.zeros((0, LENGTH), np.uint8))
            descriptors = np.asarray(opened.read_descriptors(image).data).reshape(-1, LENGTH)
            positions = _positions(opened, image)
            return PhotoSide(cameras[image], positions, descriptors, image, alike)

        def submit(i: int, j: int) -> Future[NDArray[np.uint32]]:
            return pool.submit(match, read_features(i), read_features(j), max_error)

        report = functools.partial(progress.report, what="matched pairs")
        _in_blocks(pairs, opened.exists_matches, submit, opened.write_matches, report)


def verify_pairs(
    database: Path,
    pairs: list[tuple[int, int]],
    max_error: float,
    threads: int,
    progress: WorkerProgress,
) -> None:
    """Verify the matches of those ``pairs`` that are not verified yet; see `verify_matches`.

    The lenses are those in the database.
    """
    with closing_database(database) as opened, ThreadPoolExecutor(threads) as pool:
        cameras = _cameras(opened)

        @functools.lru_cache(_CACHED_PHOTOS)
        def side(image: int) -> Side:
            return cameras[image], _positions(opened, image)

        def submit(i: int, j: int) -> Future[pycolmap.TwoViewGeometry]:
            matches = opened.read_matches(i, j)
            return pool.submit(verify_matches, side(i), side(j), matches, max_error)

        report = functools.partial(progress.report, what="verified pairs")
        exists, write = opened.exists_two_view_geometry, opened.write_two_view_geometry
        _in_blocks(pairs, exists, submit, write, report)
        report(len(pairs), len(pairs))


def _in_blocks(
    pairs: Sequence[tuple[int, int]],
    exists: Callable[[int, int], bool],
    submit: Callable[[int, int], Future[Any]],
    write: Callable[[int, int, Any], None],
    report: Callable[[int, int], None],
) -> None:
    """Compute the results of those ``pairs`` that do not exist yet in threads, and write them in
    blocks. The functions take image ids."""
    remaining = [(i + 1, j + 1) for i, j in pairs if not exists(i + 1, j + 1)]
    for start in range(0, len(remaining), _PAIRS_PER_BLOCK):
        report(len(pairs) - len(remaining) + start, len(pairs))
        block = remaining[start : start + _PAIRS_PER_BLOCK]
        jobs = [submit(*pair) for pair in block]
        for pair, job in zip(block, jobs, strict=True):
            write(*pair, job.result())


def _cameras(database: pycolmap.Database) -> dict[int, pycolmap.Camera]:
    """The camera of each photo, by image id."""
    images = database.read_all_images()
    return {image.image_id: database.read_camera(image.camera_id) for image in images}


def _positions(database: pycolmap.Database, image: int) -> _Floats:
    """(N, 2) float64, of the features of a photo."""
    return np.asarray(database.read_keypoints(image)[:, :2], np.float64)


def verify_matches(
    first: Side, second: Side, matches: NDArray[np.uint32], max_error: float
) -> pycolmap.TwoViewGeometry:
    """The matches of a pair of photos that agree with a relative pose, and the kind of the pair.

    COLMAP looks for an essential matrix, a fundamental matrix and a homography among all matches.
    Most pairs are not flat, so for the homography, this takes many samples of RANSAC in vain. So a
    fundamental matrix is estimated first, which agrees with the matches of all kinds of pairs.
    Among the matches that agree with it, a few samples are enough to find each kind of model, or
    to reject it. Each model is estimated with a part of the matches, and all are compared with it.
    With few matches, COLMAP looks among all of them at once.

    Args:
        matches: (M, 2) indices of features.
        max_error: the largest distance of a verified match from its epipolar line, in pixels of
            the photos in ``input/``.
    """
    (one, points), (other, others) = first, second
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = MIN_INLIERS
    ransac = options.ransac
    ransac.max_num_trials, ransac.max_error, ransac.random_seed = _MAX_TRIALS, max_error, SEED
    ransac.min_inlier_ratio = _inlier_ratio(len(matches))
    pinholes = one.is_perspective_pinhole() and other.is_perspective_pinhole()
    found = None
    if len(matches) >= _FEW and pinholes:
        calibrated = one.has_prior_focal_length and other.has_prior_focal_length
        matrix, agreeing = _consensus(points[matches[:, 0]], others[matches[:, 1]], ransac)
        matches = matches[agreeing]
        ransac.min_inlier_ratio, ransac.min_num_trials = _AGREEING, _FEWEST_TRIALS
        if len(matches) >= MIN_INLIERS:
            found = _from_a_part(first, second, matches, None if calibrated else matrix, options)
    if found is not None:
        return found
    if len(matches) < MIN_INLIERS:
        return pycolmap.TwoViewGeometry()
    return pycolmap.estimate_two_view_geometry(one, points, other, others, matches, options)


def _from_a_part(
    first: Side,
    second: Side,
    matches: NDArray[np.uint32],
    matrix: _Floats | None,
    options: pycolmap.TwoViewGeometryOptions,
) -> pycolmap.TwoViewGeometry | None:
    """The kind of a pair, from `_ENOUGH` of its ``matches``; None: all of them are needed.

    ``matrix``: the fundamental matrix of the ``matches``, if both focal lengths are only guessed.
    """
    (one, points), (other, others) = first, second
    some = matches[np.linspace(0, len(matches) - 1, min(_ENOUGH, len(matches))).astype(int)]
    if matrix is not None:
        flat = pycolmap.estimate_homography_matrix(
            points[some[:, 0]], others[some[:, 1]], options.ransac
        )
        if flat is None or flat["num_inliers"] < _FLAT * len(some):
            found = pycolmap.TwoViewGeometry()
            found.config, found.F = _KINDS.UNCALIBRATED.value, matrix
            found.inlier_matches = matches
            return found
    if len(some) == len(matches):
        return None
    found = pycolmap.estimate_two_view_geometry(one, points, other, others, some, options)
    if found.config not in _USUAL:
        return None
    if matrix is not None and found.H is not None and found.config != _KINDS.UNCALIBRATED.value:
        # On a plane, a false match may be on its epipolar line: a repeated window, for example.
        moved = np.column_stack([points[matches[:, 0]], np.ones(len(matches))]) @ found.H.T
        distance = np.hypot(*(moved[:, :2] / moved[:, 2:] - others[matches[:, 1]]).T)
        matches = matches[distance <= options.ransac.max_error]
    elif matrix is None and found.E is not None:
        rays = one.cam_from_img(points[matches[:, 0]]), other.cam_from_img(others[matches[:, 1]])
        focal = 0.5 * (one.mean_focal_length() + other.mean_focal_length())
        errors = sampson_distances(found.E, np.asarray(rays[0]), np.asarray(rays[1]))
        agreeing = errors <= options.ransac.max_error / focal
        if agreeing.mean() > options.min_E_F_inlier_ratio:
            matches = matches[agreeing]
    found.inlier_matches = matches
    return found


def _inlier_ratio(matches: int) -> float:
    """The smallest share of inliers that RANSAC has to find among this number of matches.

    The number of samples in RANSAC depends on it. A pair with few matches and `MIN_INLIERS`
    inliers has a high share, so a few samples suffice to find the inliers or to reject the pair.
    """
    least = MIN_INLIERS / max(1, matches)
    return next((ratio for ratio in _INLIER_RATIOS if ratio <= least), _INLIER_RATIOS[-1])


def _consensus(
    first: _Floats, second: _Floats, options: pycolmap.RANSACOptions
) -> tuple[_Floats | None, NDArray[np.bool_]]:
    """The fundamental matrix (3, 3) with which the most matches agree, and (M,) which ones do.

    ``first``, ``second``: (M, 2). None: no matrix was found.
    """
    some = np.linspace(0, len(first) - 1, min(SAMPLE, len(first))).astype(int)
    found = pycolmap.estimate_fundamental_matrix(first[some], second[some], options)
    if found is not None and found["num_inliers"] > _MOST * len(some):
        return found["F"], sampson_distances(found["F"], first, second) <= options.max_error
    found = pycolmap.estimate_fundamental_matrix(first, second, options)
    if found is None:
        return None, np.zeros(len(first), bool)
    return found["F"], np.asarray(found["inlier_mask"], bool)
