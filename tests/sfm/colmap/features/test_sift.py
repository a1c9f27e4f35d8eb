"""Features of one photo: where they are, how large they are, and which are kept."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from PIL import Image
from tests.sfm.colmap.scenes import texture

from snowsplat.sfm.colmap.features import sift
from snowsplat.sfm.colmap.features.sift import detect_in_grey, detect_sift, photos_at_once
from snowsplat.sfm.colmap.pairs.matching import match_descriptors

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


def grey_picture(width, height):
    """A picture with features of many sizes, (height, width)."""
    image = Image.fromarray(np.uint8(255 * texture(5)))
    return np.asarray(image.resize((width, height), Image.Resampling.BICUBIC))


def differences(found, expected):
    """The smallest difference of each keypoint (N, 6) from those of ``expected`` (M, 6) in scales
    of the feature, and the index of that keypoint."""
    scale = np.hypot(found[:, 2], found[:, 4])
    distance = np.abs(found[:, None] - expected).max(2) / scale[:, None]
    return distance.min(1), distance.argmin(1)


def of_opencv(grey):
    """Keypoints (N, 6) and RootSIFT descriptors (N, 128)."""
    sift = cv2.SIFT.create(contrastThreshold=0.02, enable_precise_upscale=True)
    points, histograms = sift.detectAndCompute(grey, None)
    if not points:
        return np.zeros((0, 6)), np.zeros((0, 128))
    scale, angle = (np.array([getattr(p, n) for p in points]) for n in ("size", "angle"))
    cos, sin = (scale / 2 * f(np.radians(angle)) for f in (np.cos, np.sin))
    keypoints = np.column_stack([np.array([p.pt for p in points]) + 0.5, cos, -sin, sin, cos])
    root = 512 * np.sqrt(histograms / histograms.sum(1, keepdims=True))
    return keypoints, np.rint(root)


# The widths are not multiples of those of vectors; octaves have odd sizes.
@pytest.mark.isa
@pytest.mark.parametrize("size", [(61, 47), (30, 111), (320, 240)])
def test_features_are_those_of_opencv(size):
    grey = grey_picture(*size)
    keypoints, descriptors = of_opencv(grey)
    found = detect_in_grey(grey, None, ALL)
    assert len(keypoints) > 40
    assert len(found.keypoints) == pytest.approx(len(keypoints), rel=0.01)
    for some, others in ((found.keypoints, keypoints), (keypoints, found.keypoints)):
        difference, _ = differences(some, others)
        assert (difference < 0.002).mean() > 0.95
        assert (difference < 0.02).mean() > 0.99  # others are at a threshold
    difference, which = differences(found.keypoints, keypoints)
    same = difference < 0.002
    distance = np.linalg.norm(found.descriptors[same] - descriptors[which[same]], axis=1) / 512
    assert np.quantile(distance, 0.95) < 0.01  # a value near 0.5 becomes 0 or 1, and its root 7


@pytest.mark.isa
@pytest.mark.parametrize("size", [(1, 1), (5, 300), (6, 6), (300, 6)])
def test_small_and_narrow_photos(size):
    grey = np.random.default_rng(0).integers(0, 256, size[::-1], dtype=np.uint8)
    assert len(detect_in_grey(grey, None, ALL).keypoints) == len(of_opencv(grey)[0])


@pytest.mark.isa
def test_photos_that_are_processed_in_parallel():
    greys = [grey_picture(200 + 10 * i, 150) for i in range(4)]
    one_by_one = [detect_in_grey(grey, None, 200) for grey in greys]
    with ThreadPoolExecutor(4) as pool:
        parallel = list(pool.map(lambda grey: detect_in_grey(grey, None, 200), greys))
    for a, b in zip(one_by_one, parallel, strict=True):
        assert np.array_equal(a.keypoints, b.keypoints)
        assert np.array_equal(a.descriptors, b.descriptors)


@pytest.mark.isa
def test_images_may_have_any_strides():
    grey = grey_picture(101, 80)
    allowed = np.ones_like(grey)
    allowed[:, :50] = 0
    expected = detect_in_grey(grey[::2].copy(), allowed[::2].copy(), ALL)
    found = detect_in_grey(grey[::2], np.asfortranarray(allowed[::2]), ALL)
    assert len(found.keypoints) > 5
    assert np.array_equal(found.keypoints, expected.keypoints)
    assert np.array_equal(found.descriptors, expected.descriptors)


def test_invalid_input():
    good = np.zeros((20, 30), np.uint8)
    for grey, allowed, message in (
        (good[0], None, "not enough values"),
        (good.astype(np.float32), None, r"grey .*, got \(20, 30\) float32"),
        (good, good[1:], r"allowed .*, got \(19, 30\) uint8"),
        (good, good > 0, r"allowed .*, got \(20, 30\) bool"),
    ):
        with pytest.raises(ValueError, match=message):
            detect_in_grey(grey, allowed, 10)


def test_not_enough_memory(monkeypatch):
    monkeypatch.setattr(sift, "call_with_arrays", lambda name, **fields: -1)
    with pytest.raises(MemoryError, match="not enough memory to detect features in a photo"):
        detect_in_grey(np.zeros((20, 20), np.uint8), None, 10)


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
    assert (np.diff(size) < 1e-4).all()
    assert np.array_equal(few.keypoints, every.keypoints[:100])
    assert np.array_equal(few.descriptors, every.descriptors[:100])


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
    assert photos_at_once(1600, 64) == 13
    assert photos_at_once(1600, 2) == 2
    assert photos_at_once(9000, 64) == 1
    monkeypatch.setattr(sift, "memory_bytes", lambda: 0)  # unknown
    assert photos_at_once(1600, 64) == 64
