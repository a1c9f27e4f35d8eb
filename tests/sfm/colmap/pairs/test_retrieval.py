"""The visual similarity of photos, from their features."""

import numpy as np

from snowsplat.sfm.colmap.pairs.choice import nearest, similarity


def places(count, per_place, seed=0):
    """Descriptors of photos: those of one place share noisy features; others share none."""
    random = np.random.default_rng(seed)
    photos = []
    for _ in range(count):
        features = random.random((300, 128))
        for _ in range(per_place):
            some = features[random.permutation(300)[:200]]
            photos.append(some + random.normal(0, 0.02, some.shape))
    return photos


def test_photos_of_one_place_find_each_other():
    alike = similarity(places(8, 4))
    assert alike.shape == (32, 32)
    assert np.allclose(np.diag(alike), 1)
    for i, j in nearest(alike, range(3)):
        assert i // 4 == j // 4


def test_photos_without_features_are_similar_to_none():
    photos = places(3, 3)
    photos[4] = np.zeros((0, 128))
    alike = similarity(photos)
    assert np.isfinite(alike).all()
    assert (np.delete(alike[4], 4) == 0).all()
    assert np.array_equal(similarity([np.zeros((0, 128))] * 3), np.eye(3))


def test_nearest_returns_count_partners_of_each():
    alike = np.array([[1, 0.9, 0.1], [0.9, 1, 0.2], [0.1, 0.2, 1]])
    assert nearest(alike, range(1)) == {(0, 1), (1, 2)}
    assert nearest(alike, range(5)) == {(0, 1), (0, 2), (1, 2)}
