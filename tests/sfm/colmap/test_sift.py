"""Features of one photo: where they are, how large they are, and which are kept."""

import numpy as np
import pytest
from PIL import Image
from tests.sfm.colmap.scenes import texture

from snowsplat.sfm.colmap import sift
from snowsplat.sfm.colmap.matching import match_descriptors
from snowsplat.sfm.colmap.sift import detect_sift, photos_at_once

ALL = 100_000


@pytest.fixture(scope="module")
def picture():
    grey = Image.fromarray(np.uint8(255 * texture(3)))
    return grey.convert("RGB").resize((360, 240), Image.Resampling.BICUBIC)


def saved(image, path):
    image.save(path)
    return path


def matched(first, second):
    """The matched keypoints of both photos, (K, 6) each. Equal rows belong to one match."""
    pairs = match_descriptors(first.descriptors, second.descriptors)
    assert len(pairs) > 50
    return first.keypoints[pairs[:, 0]], second.keypoints[pairs[:, 1]]


def test_positions_and_matrices_turn_with_the_photo(tmp_path, picture):
    upright = detect_sift(saved(picture, tmp_path / "a.png"), None, 1000, ALL)
    turned = picture.transpose(Image.Transpose.ROTATE_90)  # counterclockwise
    a, b = matched(upright, detect_sift(saved(turned, tmp_path / "b.png"), None, 1000, ALL))
    expected = np.stack([a[:, 1], picture.width - a[:, 0]], 1)
    assert np.abs(np.median(b[:, :2] - expected, 0)).max() < 0.02
    # The columns of the matrix are the axes of the feature in the photo.
    axes = a[:, 2:].reshape(-1, 2, 2)
    expected = np.stack([axes[:, 1], -axes[:, 0]], 1).reshape(-1, 4)
    assert np.median(np.abs(b[:, 2:] - expected)) < 0.05 * np.median(np.abs(expected))


def test_positions_and_scales_are_in_pixels_of_the_photo(tmp_path, picture):
    large = picture.resize((720, 480), Image.Resampling.BICUBIC)
    original = detect_sift(saved(picture, tmp_path / "a.png"), None, 1000, ALL)
    for name in ("b.png", "b.jpg"):  # a JPEG is decoded at half its size
        a, b = matched(original, detect_sift(saved(large, tmp_path / name), None, 360, ALL))
        assert np.abs(np.median(b[:, :2] - 2 * a[:, :2], 0)).max() < 0.05
        assert np.median(b[:, 2:] / a[:, 2:]) == pytest.approx(2, rel=0.02)


def test_the_largest_features_are_kept(tmp_path, picture):
    path = saved(picture, tmp_path / "a.png")
    every, few = detect_sift(path, None, 1000, ALL), detect_sift(path, None, 1000, 100)
    assert len(every.keypoints) > 300
    assert len(few.keypoints) == len(few.descriptors) == 100
    size = np.hypot(every.keypoints[:, 2], every.keypoints[:, 4])
    largest = np.argsort(-size, kind="stable")[:100]
    assert np.array_equal(few.keypoints, every.keypoints[largest])
    # The descriptors of few features are computed after the choice, those of many before. If all of
    # them are large, OpenCV does not double the photo: the pyramid differs a bit.
    difference = few.descriptors.astype(int) - every.descriptors[largest]
    assert (np.abs(difference) > 1).mean() < 0.01


def test_descriptors_have_the_norm_that_matching_assumes(tmp_path, picture):
    descriptors = detect_sift(saved(picture, tmp_path / "a.png"), None, 1000, ALL).descriptors
    norm = np.linalg.norm(descriptors.astype(float), axis=1)
    assert np.abs(norm / 512 - 1).max() < 0.02


def test_no_features_at_black_pixels_of_the_mask(tmp_path, picture):
    white = np.zeros((120, 180), np.uint8)
    white[:, 90:] = 255
    mask = saved(Image.fromarray(white), tmp_path / "mask.png")
    x = detect_sift(saved(picture, tmp_path / "a.png"), mask, 1000, ALL).keypoints[:, 0]
    assert len(x) > 100
    assert x.min() > 178


def test_a_photo_without_structure_has_no_features(tmp_path):
    path = saved(Image.new("RGB", (300, 200), (90, 80, 70)), tmp_path / "a.png")
    found = detect_sift(path, None, 1000, ALL)
    assert found.keypoints.shape == (0, 6)
    assert found.descriptors.shape == (0, 128)


def test_fewer_photos_at_once_if_the_memory_is_small(monkeypatch):
    monkeypatch.setattr(sift, "memory_bytes", lambda: 8 << 30)
    assert photos_at_once(1600, 64) == 3
    assert photos_at_once(1600, 2) == 2
    assert photos_at_once(9000, 64) == 1
    monkeypatch.setattr(sift, "memory_bytes", lambda: 0)  # unknown
    assert photos_at_once(1600, 64) == 64
