"""Matching of descriptors: the exact result, COLMAP's own matches, threads, invalid input."""

import subprocess
import sys

import numpy as np
import pycolmap
import pytest

from snowsplat.sfm.colmap.database import closing_database, open_database
from snowsplat.sfm.colmap.lenses.lens import Lens
from snowsplat.sfm.colmap.pairs.matching import (
    LENGTH,
    Searched,
    look_alikes,
    match_descriptors,
    two_nearest,
)
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.util import native_library


def reference(first, second):
    """The result of `two_nearest`, from the matrix of all products; no array may be empty."""
    products = first.astype(np.int64) @ second.astype(np.int64).T
    for matrix in (products, products.T):
        with_zero = np.concatenate([np.sort(matrix, 1), np.zeros((len(matrix), 1), int)], 1)
        second_best = with_zero[:, -3] if matrix.shape[1] > 1 else with_zero[:, -1]
        yield matrix.argmax(1), with_zero[:, -2], second_best


def random_descriptors(random, count, values=256):
    return random.integers(0, values, (count, LENGTH), dtype=np.uint8)


def sift_like(random, count):
    """Descriptors with the norm of those of COLMAP."""
    values = random.exponential(size=(count, LENGTH))
    return normalised(np.sqrt(values))


def normalised(values):
    values = 512 * values / np.linalg.norm(values, axis=1, keepdims=True)
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


# Counts near the sizes of tiles (4 or 6 rows; 8, 16, 48 or 64 columns) and of tasks.
@pytest.mark.isa
@pytest.mark.parametrize(
    ("n", "m"), [(1, 1), (1, 2), (5, 7), (6, 64), (97, 65), (64, 49), (193, 200), (6200, 130)]
)
@pytest.mark.parametrize("values", [2, 256])
def test_the_result_is_exact(n, m, values):
    """With two values, many products are equal; the first of them must be found."""
    random = np.random.default_rng(n + values)
    first, second = (random_descriptors(random, count, values) for count in (n, m))
    if values == 256:
        first[-1] = second[-1] = 255  # the largest product
    for found, expected in zip(two_nearest(first, second), reference(first, second), strict=True):
        for column, wanted in zip(found, expected, strict=True):
            np.testing.assert_array_equal(column, wanted)


@pytest.mark.isa
def test_descriptors_of_zeros_are_found():
    zeros = np.zeros((3, LENGTH), np.uint8)
    rows, columns = two_nearest(zeros, zeros[:2])
    assert [list(column) for column in rows] == [[0, 0, 0]] * 3
    assert [list(column) for column in columns] == [[0, 0]] * 3


@pytest.mark.isa
def test_nothing_to_search_in():
    descriptors = random_descriptors(np.random.default_rng(0), 3)
    rows, columns = two_nearest(descriptors, descriptors[:0])
    assert (list(rows.which), list(rows.best)) == ([-1] * 3, [-1] * 3)
    assert [len(column) for column in columns] == [0, 0, 0]
    for first, second in ((3, 0), (0, 3), (0, 0)):
        assert match_descriptors(descriptors[:first], descriptors[:second]).shape == (0, 2)


@pytest.mark.isa
def test_the_number_of_threads_does_not_change_the_result():
    random = np.random.default_rng(1)
    first, second = random_descriptors(random, 500, 2), random_descriptors(random, 700, 2)
    before = native_library.library()[1].get_num_threads()
    results = []
    for threads in (1, 3):
        native_library.set_num_threads(threads)
        results.append(np.concatenate(two_nearest(first, second), axis=None))
    native_library.set_num_threads(before)
    np.testing.assert_array_equal(*results)


def test_matches_are_those_of_colmap(tmp_path):
    """Half of the descriptors are in both photos, with noise of every size."""
    random = np.random.default_rng(2)
    first, second = sift_like(random, 700), sift_like(random, 600)
    noise = random.normal(size=(300, LENGTH)) * np.linspace(0, 40, 300)[:, None]
    second[:300] = normalised(np.abs(first[200:500] + noise))
    second[300] = second[10]  # not distinctive
    found = match_descriptors(first, second)
    np.testing.assert_array_equal(found, matches_of_colmap(tmp_path, first, second))
    assert found.dtype == np.uint32
    assert 100 < len(found) < 299
    assert (found[:, 0] - found[:, 1] == 200).mean() > 0.99
    assert 210 not in found[:, 0]


def matches_of_colmap(folder, first, second):
    path = folder / "database.db"
    names = ("1.jpg", "2.jpg")
    photos = [Photo(n, n, 640, 480, "") for n in names]
    open_database(path, photos, Lens("PINHOLE"), "")
    sift = pycolmap.FeatureExtractorType.SIFT
    with closing_database(path) as database:
        for image_id, descriptors in ((1, first), (2, second)):
            database.write_keypoints(image_id, np.zeros((len(descriptors), 4), np.float32))
            database.write_descriptors(image_id, pycolmap.FeatureDescriptors(sift, descriptors))
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, 1
    options.skip_geometric_verification = True
    options.sift.cpu_brute_force_matcher = True
    pycolmap.match_exhaustive(path, matching_options=options, device=pycolmap.Device.cpu)
    with closing_database(path) as database:
        return database.read_matches(1, 2)


def test_invalid_input():
    good = np.zeros((2, LENGTH), np.uint8)
    for bad, message in (
        (good[:, :64], r"second must be \(2, 128\) uint8, got \(2, 64\)"),
        (good[0], r"second must be \(128, 128\) uint8, got \(128,\)"),
        (good.astype(np.float32), r"second must be .*, got \(2, 128\) float32"),
    ):
        with pytest.raises(ValueError, match=message):
            two_nearest(good, bad)


@pytest.mark.isa
def test_arrays_may_have_any_strides():
    random = np.random.default_rng(3)
    first, second = random_descriptors(random, 40), random_descriptors(random, 30)
    expected = two_nearest(first[::2], second)
    found = two_nearest(first[::2].copy(), np.asfortranarray(second))
    np.testing.assert_array_equal(
        np.concatenate(found, axis=None), np.concatenate(expected, axis=None)
    )


@pytest.mark.slow
def test_the_child_process_does_not_import_torch():
    code = "import sys, snowsplat.sfm.colmap.process.worker; print('torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout == "False\n", result.stderr


@pytest.mark.isa
@pytest.mark.parametrize("common", [0, 3, 70, 200])
def test_only_the_descriptors_in_the_ranges_are_compared(common):
    random = np.random.default_rng(common)
    first, second = random_descriptors(random, 150, 3), random_descriptors(random, 260, 3)
    begin, end = np.sort(random.integers(0, 261, (2, 150)).astype(np.int32), axis=0)
    begin[:40], end[:40] = np.arange(40), np.arange(40) + 20  # narrower than a tile
    end[60:66] = begin[60:66]  # nothing but the common ones
    columns = np.arange(260)
    searched = (columns < common) | ((columns >= begin[:, None]) & (columns < end[:, None]))
    products = np.where(searched, first.astype(np.int64) @ second.astype(np.int64).T, -1)
    found = two_nearest(first, second, Searched(common, begin, end))
    for nearest, matrix in zip(found, (products, products.T), strict=True):
        best = matrix.max(1)
        np.testing.assert_array_equal(nearest.which, np.where(best < 0, -1, matrix.argmax(1)))
        np.testing.assert_array_equal(nearest.best, best)
        np.testing.assert_array_equal(nearest.second, np.maximum(np.sort(matrix, 1)[:, -2], 0))


@pytest.mark.isa
def test_look_alikes_are_the_nearest_of_the_same_photo():
    descriptors = random_descriptors(np.random.default_rng(4), 130)
    products = descriptors.astype(np.int64) @ descriptors.astype(np.int64).T
    np.fill_diagonal(products, 0)
    np.testing.assert_array_equal(look_alikes(descriptors), products.max(1))
    assert list(look_alikes(descriptors[:1])) == [0]
    assert len(look_alikes(descriptors[:0])) == 0


def test_ranges_beyond_the_descriptors_are_refused():
    good = np.zeros((2, LENGTH), np.uint8)
    ends = np.array([0, 2], np.int32)
    for searched, message in (
        (Searched(3, ends, ends), "common must be from 0 to 2, got 3"),
        (Searched(0, ends - 1, ends), "begin must be from 0 to 2"),
        (Searched(0, ends, ends + 1), "end must be from 0 to 2"),
        (Searched(0, ends, ends.astype(float)), r"end must be \(2,\) int32"),
    ):
        with pytest.raises(ValueError, match=message):
            two_nearest(good, good, searched)
