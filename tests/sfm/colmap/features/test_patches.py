"""Patches of features: what they show, and how exactly they are aligned."""

import numpy as np
import pytest

from snowsplat.sfm.colmap.features.alignment import SIDE, align_patches, cut_patches, patch_axes
from snowsplat.util import native_library
from snowsplat.util.native_layout import ALIGNMENT_RADIUS

CENTRE = SIDE // 2


def grid(radius):
    """(2, H, W) the coordinates u (to the right) and v (down), from the centre."""
    offset = np.arange(-radius, radius + 1.0)
    return np.stack(np.meshgrid(offset, offset))


def surface(random):
    """A smooth picture: a function of positions (2, ...) with values from about 60 to 190."""
    waves = random.normal(0, 0.35, (12, 2))
    phases = random.uniform(0, 2 * np.pi, 12)

    def value(at):
        angle = np.tensordot(waves, at, 1) + phases.reshape(-1, *[1] * (at.ndim - 1))
        return 125 + 13 * np.sin(angle).sum(0)

    return value


def patch_of(value, transform=((1, 0, 0), (0, 1, 0)), gain=1.0, offset=0.0):
    """The picture `value` as seen in the second patch: ``transform`` maps the first to it."""
    matrix, shift = np.array(transform)[:, :2], np.array(transform)[:, 2]
    at = np.tensordot(np.linalg.inv(matrix), grid(CENTRE) - shift[:, None, None], 1)
    return np.rint(gain * value(at) + offset).clip(0, 255).astype(np.uint8)


def random_transforms(random, count):
    transforms = np.zeros((count, 2, 3))
    transforms[:, :, :2] = np.eye(2) + random.normal(0, 0.08, (count, 2, 2))
    transforms[:, :, 2] = random.uniform(-1.5, 1.5, (count, 2))
    return transforms


def reference(first, second):
    """`align_patches` of one pair, in float64."""
    u, v = grid(ALIGNMENT_RADIUS).reshape(2, -1)
    weight = np.exp(-(u**2 + v**2) / (2 * (ALIGNMENT_RADIUS / 2) ** 2))
    weight /= weight.sum()

    def sample(patch, x, y):
        x, y = (np.clip(c + CENTRE, 0, SIDE - 1) for c in (x, y))
        i, j = (np.minimum(c.astype(int), SIDE - 2) for c in (y, x))
        p, q = x - j, y - i
        patch = patch.astype(float)
        upper = patch[i, j] * (1 - p) + patch[i, j + 1] * p
        return upper * (1 - q) + (patch[i + 1, j] * (1 - p) + patch[i + 1, j + 1] * p) * q

    gx = (sample(first, u + 1, v) - sample(first, u - 1, v)) / 2
    gy = (sample(first, u, v + 1) - sample(first, u, v - 1)) / 2
    window = sample(first, u, v)
    jacobian = np.stack([gx * u, gx * v, gx, gy * u, gy * v, gy, window, np.ones_like(u)], 1)
    normal = jacobian.T @ (weight[:, None] * jacobian)
    normal += np.diag(1e-4 * np.diag(normal) + 1e-3)
    transform = np.eye(3)
    for _ in range(10):
        x, y, _ = transform @ np.stack([u, v, np.ones_like(u)])
        solution = np.linalg.solve(normal, jacobian.T @ (weight * sample(second, x, y)))
        change = solution[:6].reshape(2, 3) / np.clip(solution[6], 0.3, 3)
        transform = transform @ np.linalg.inv(np.eye(3) + np.vstack([change, np.zeros(3)]))
    x, y, _ = transform @ np.stack([u, v, np.ones_like(u)])
    covariance = np.cov(window, sample(second, x, y), aweights=weight)
    return transform[:2], covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])


@pytest.mark.isa
def test_transform_gain_and_offset_are_found():
    random = np.random.default_rng(0)
    transforms = random_transforms(random, 200)
    patches = []
    for transform in transforms:
        value = surface(random)
        patches += [patch_of(value), patch_of(value, transform, random.uniform(0.6, 1.3), -9)]
    pairs = np.arange(400, dtype=np.int32).reshape(-1, 2)
    aligned = align_patches(np.stack(patches), pairs)
    assert np.mean(aligned.correlation > 0.98) > 0.95
    error = np.abs(aligned.transform - transforms)
    assert np.quantile(error[:, :, 2], 0.95) < 0.05  # pixels
    assert np.quantile(error[:, :, :2], 0.95) < 0.02
    assert np.median(np.abs(transforms[:, :, 2])) > 0.5  # before


@pytest.mark.isa
def test_the_result_is_that_of_the_reference():
    random = np.random.default_rng(1)
    count = 30
    patches = []
    for transform in random_transforms(random, count):
        value = surface(random)
        noise = random.normal(0, 3, (2, SIDE, SIDE))
        both = np.stack([patch_of(value), patch_of(value, transform)]) + noise
        patches.append(both.clip(0, 255).astype(np.uint8))
    pairs = np.arange(2 * count, dtype=np.int32).reshape(-1, 2)
    aligned = align_patches(np.concatenate(patches), pairs)
    for k, (first, second) in enumerate(patches):
        transform, correlation = reference(first, second)
        np.testing.assert_allclose(aligned.transform[k], transform, atol=0.01)
        assert aligned.correlation[k] == pytest.approx(correlation, abs=2e-3)


@pytest.mark.isa
def test_patches_without_texture_and_patches_of_different_places():
    random = np.random.default_rng(2)
    flat = np.full((SIDE, SIDE), 90, np.uint8)
    places = [patch_of(surface(random)) for _ in range(41)]
    patches = np.stack([flat, *places])
    aligned = align_patches(patches, np.array([[0, 1], [1, 0], [0, 0]], np.int32))
    assert np.isfinite(aligned.transform).all()
    assert list(aligned.correlation) == [-1, -1, -1]
    others = np.stack([np.full(40, 1), np.arange(2, 42)], 1).astype(np.int32)
    assert np.median(align_patches(patches, others).correlation) < 0.6


@pytest.mark.isa
def test_any_patches_give_finite_transforms():
    """Also patches with few grey values, for which the equations are nearly singular."""
    random = np.random.default_rng(5)
    stripes = np.tile(np.where(np.arange(SIDE) % 2, 255, 0).astype(np.uint8), (SIDE, 1))
    spot = np.zeros((SIDE, SIDE), np.uint8)
    spot[CENTRE, CENTRE] = 255
    noise = random.integers(0, 256, (20, SIDE, SIDE), dtype=np.uint8)
    patches = np.stack([stripes, stripes.T, spot, 255 - spot, *noise, *(noise[:9] // 255 * 255)])
    pairs = np.stack(np.meshgrid(*2 * [np.arange(len(patches))]), -1).reshape(-1, 2)
    aligned = align_patches(patches, pairs.astype(np.int32))
    assert np.isfinite(aligned.transform).all()
    assert np.abs(aligned.transform[:, :, 2]).max() <= CENTRE
    assert (np.abs(aligned.correlation) <= 1.00001).all()


@pytest.mark.isa
def test_the_number_of_threads_does_not_change_the_result():
    random = np.random.default_rng(3)
    patches = np.stack([patch_of(surface(random)) for _ in range(20)])
    pairs = random.integers(0, 20, (300, 2), dtype=np.int32)
    before = native_library.library()[1].get_num_threads()
    results = []
    for threads in (1, 3):
        native_library.set_num_threads(threads)
        results.append(align_patches(patches, pairs))
    native_library.set_num_threads(before)
    for one, three in zip(*results, strict=True):
        np.testing.assert_array_equal(one, three)


@pytest.mark.parametrize(
    ("patches", "pairs", "message"),
    [
        (np.zeros((2, SIDE, 5), np.uint8), np.zeros((1, 2), np.int32), "patches must be"),
        (np.zeros((2, SIDE, SIDE), np.float32), np.zeros((1, 2), np.int32), "patches must be"),
        (np.zeros((2, SIDE, SIDE), np.uint8), np.zeros((1, 2), np.int64), "pairs must be"),
        (np.zeros((2, SIDE, SIDE), np.uint8), np.full((1, 2), 2, np.int32), "indices of 2"),
        (np.zeros((2, SIDE, SIDE), np.uint8), np.full((1, 2), -1, np.int32), "indices of 2"),
    ],
)
def test_invalid_input(patches, pairs, message):
    with pytest.raises(ValueError, match=message):
        align_patches(patches, pairs)


def test_no_pairs():
    aligned = align_patches(np.zeros((0, SIDE, SIDE), np.uint8), np.zeros((0, 2), np.int32))
    assert aligned.transform.shape == (0, 2, 3)
    assert aligned.correlation.shape == (0,)


def keypoint(x, y, scale, angle=0.0):
    cos, sin = scale * np.cos(angle), scale * np.sin(angle)
    return [x, y, cos, -sin, sin, cos]


@pytest.mark.parametrize("scale", [0.9, 2.7, 3.0, 7.0, 30.0])
@pytest.mark.parametrize("angle", [0.0, 0.7, -2.5])
def test_a_patch_is_turned_and_scaled_like_its_feature(scale, angle):
    """On a slope, the value at each place is known, also in a reduced photo."""
    y, x = np.mgrid[:600, :800] + 0.5  # centres of the pixels
    grey = np.rint(30 + 0.15 * x + 0.1 * y).astype(np.uint8)
    keypoints = np.array([keypoint(400.3, 299.1, scale, angle)] * 2)
    axes = patch_axes(keypoints)
    step = max(1, scale / 1.5)
    np.testing.assert_allclose(axes[0] / step, [[np.cos(angle), -np.sin(angle)],
                                                [np.sin(angle), np.cos(angle)]])  # fmt: skip
    patches = cut_patches(grey, keypoints[:, :2], axes)
    u, v = grid(CENTRE)
    at_x = 400.3 + step * (np.cos(angle) * u - np.sin(angle) * v)
    at_y = 299.1 + step * (np.sin(angle) * u + np.cos(angle) * v)
    expected = 30 + 0.15 * at_x + 0.1 * at_y
    assert np.abs(patches[1] - expected)[5:-5, 5:-5].max() < 1.1  # both are rounded
    assert abs((patches[1] - expected)[5:-5, 5:-5].mean()) < 0.1


def test_outside_of_the_photo_its_border_is_repeated():
    grey = np.full((50, 60), 80, np.uint8)
    grey[:, 0] = 200
    (patch,) = cut_patches(grey, np.array([[0.5, 25.5]]), np.eye(2)[None])
    assert (patch[:, : CENTRE + 1] == 200).all()
    assert (patch[:, CENTRE + 1 :] == 80).all()


def test_many_features():
    """More than OpenCV processes at once."""
    random = np.random.default_rng(4)
    grey = random.integers(0, 255, (300, 400), dtype=np.uint8)
    positions = np.round(random.uniform(40, 250, (3000, 2))) + 0.5
    patches = cut_patches(grey, positions, np.tile(np.eye(2), (3000, 1, 1)))
    for k in range(0, 3000, 299):
        x, y = positions[k].astype(int)
        expected = grey[y - CENTRE : y + CENTRE + 1, x - CENTRE : x + CENTRE + 1]
        np.testing.assert_array_equal(patches[k], expected)
    assert cut_patches(grey, positions[:0], np.zeros((0, 2, 2))).shape == (0, SIDE, SIDE)
