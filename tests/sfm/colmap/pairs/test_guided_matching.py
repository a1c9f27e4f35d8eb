"""Matching near the epipolar lines."""

import numpy as np
import pycolmap
import pytest

from snowsplat.sfm.colmap.pairs import guided_matching
from snowsplat.sfm.colmap.pairs.guided_matching import PhotoSide, match
from snowsplat.sfm.colmap.pairs.matching import LENGTH, match_descriptors

COUNT, UNRELATED = 900, 300


def normalised(values):
    values = 512 * values / np.linalg.norm(values, axis=1, keepdims=True)
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def photos(moved, flat=False, model="SIMPLE_PINHOLE"):
    """Two photos of `COUNT` points, in another order in the second one, and `UNRELATED` features.

    Returns the photos, and the feature of the second one for each point.
    """
    random = np.random.default_rng(1)
    lens = pycolmap.Camera.create_from_model_name(1, model, 600.0, 800, 600)
    points = random.uniform((-3, -2, 5), (3, 2, 5 if flat else 12), (COUNT, 3))
    described = random.exponential(size=(COUNT, LENGTH)) ** 0.5
    order = random.permutation(COUNT)
    sides = []
    for position, rows in (((0, 0, 0), np.arange(COUNT)), (moved, order)):
        pixels = np.asarray(lens.img_from_cam(points[rows] - np.array(position)))
        pixels += random.normal(0, 0.3, pixels.shape)
        noisy = np.abs(described[rows] + random.normal(0, 0.15, (COUNT, LENGTH)))
        others = random.exponential(size=(UNRELATED, LENGTH)) ** 0.5
        places = random.uniform((0, 0), (800, 600), (UNRELATED, 2))
        shuffled = random.permutation(COUNT + UNRELATED) if rows is order else None
        side = [np.concatenate([pixels, places]), normalised(np.concatenate([noisy, others]))]
        sides.append(PhotoSide(lens, *(side if shuffled is None else (a[shuffled] for a in side))))
    second_of_point = np.argsort(shuffled)[np.argsort(order)]
    return (*sides, second_of_point)


def guided(monkeypatch):
    """Collects the shares of the features that were compared."""
    shares, along = [], guided_matching._along_lines

    def recorded(*args):
        found = along(*args)
        searched = found[2]
        width = searched.common + np.maximum(searched.end - searched.begin, 0)
        shares.append(width.mean() / len(args[1].positions))
        return found

    monkeypatch.setattr(guided_matching, "_along_lines", recorded)
    return shares


# To the side; upwards; forward, with the epipole in the photo; to the side and forward, with the
# epipole beside the photo.
@pytest.mark.parametrize("moved", [(0.8, 0, 0), (0, -0.7, 0.1), (0.1, 0.05, 1.0), (0.8, 0.1, 0.9)])
def test_the_matches_near_the_lines_are_found(moved, monkeypatch):
    shares = guided(monkeypatch)
    first, second, partner = photos(moved)
    found = match(first, second, 4.0)
    assert len(shares) == 1
    assert shares[0] < 0.6
    points = found[:, 0] < COUNT
    assert points.sum() > 0.97 * COUNT
    assert (found[points, 1] == partner[found[points, 0]]).all()
    assert (~points).sum() < 0.02 * UNRELATED
    assert (np.diff(found[:, 0].astype(int)) > 0).all()
    assert len(np.unique(found[:, 1])) == len(found)


def test_a_feature_with_a_look_alike_in_its_own_photo_is_not_matched(monkeypatch):
    """The look-alikes are not near the line, so only their own photo shows them."""
    shares = guided(monkeypatch)
    first, second, partner = photos((0.8, 0.0, 0.0))
    repeated = np.arange(COUNT - 100, COUNT)
    copies = np.arange(COUNT, COUNT + 100)  # among the unrelated features of the first photo
    first.descriptors[copies] = first.descriptors[repeated]
    both = np.flatnonzero(second.positions[:, 1] >= 0)
    unrelated = np.setdiff1d(both, partner)[:100]
    second.descriptors[unrelated] = second.descriptors[partner[repeated]]
    found = match(first, second, 4.0)
    assert len(shares) == 1
    assert np.isin(repeated, found[:, 0]).sum() < 5
    assert len(found) > 0.97 * (COUNT - 100)


@pytest.mark.parametrize(
    "given",
    [
        {"moved": (0.8, 0, 0), "flat": True},
        {"moved": (0, 0, 0)},
        {"model": "SIMPLE_RADIAL_FISHEYE"},
    ],
)
def test_all_features_are_compared_if_the_lines_are_not_known(given, monkeypatch):
    shares = guided(monkeypatch)
    first, second, _ = photos(**{"moved": (0.8, 0, 0), **given})
    found = match(first, second, 4.0)
    assert not shares
    np.testing.assert_array_equal(found, match_descriptors(first.descriptors, second.descriptors))


def test_few_features():
    first, second, _ = photos((0.8, 0, 0))
    for count in (0, 1, 119, 130):
        sides = [
            PhotoSide(s.camera, s.positions[:count], s.descriptors[:count]) for s in (first, second)
        ]
        expected = match_descriptors(*(side.descriptors for side in sides))
        np.testing.assert_array_equal(match(*sides, 4.0), expected)
