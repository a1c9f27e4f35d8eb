"""Verification of the matches of a pair."""

import numpy as np
import pycolmap
import pytest

from snowsplat.sfm.colmap.pairs.pair_matching import _INLIER_RATIOS, _inlier_ratio, verify_matches

FLAT = {
    getattr(pycolmap.TwoViewGeometryConfiguration, name).value
    for name in ("PLANAR", "PANORAMIC", "PLANAR_OR_PANORAMIC")
}


def camera(known=False, model="SIMPLE_RADIAL"):
    made = pycolmap.Camera.create_from_model_name(1, model, 600.0, 800, 600)
    made.has_prior_focal_length = known
    return made


def photographed(points, position, lens):
    """The pixels (N, 2) of ``points`` (N, 3) in a photo that is turned by 0.1 rad about y."""
    cos, sin = np.cos(0.1), np.sin(0.1)
    turned = (points - position) @ np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
    return np.asarray(lens.img_from_cam(turned))


def scene(true, false, lens, flat=False, moved=(0.8, 0.1, 0.2)):
    """Two photos with ``true`` matches, with an error of 0.3 pixels, and then ``false`` ones."""
    random = np.random.default_rng(true)
    points = random.uniform((-2, -1.5, 4), (2, 1.5, 4 if flat else 9), (true, 3))
    pixels = [photographed(points, np.array(position), lens) for position in ((0, 0, 0), moved)]
    sides = []
    for seen in pixels:
        noisy = seen + random.normal(0, 0.3, seen.shape)
        sides.append((lens, np.concatenate([noisy, random.uniform(0, 600, (false, 2))])))
    rows = np.arange(true + false, dtype=np.uint32)
    return (*sides, np.stack([rows, rows], 1))


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize(("true", "false"), [(40, 20), (150, 30), (900, 500)])
def test_matches_that_agree_with_a_pose_are_kept(true, false, known):
    found = verify_matches(*scene(true, false, camera(known)), max_error=4.0)
    kind = "CALIBRATED" if known else "UNCALIBRATED"
    assert found.config == getattr(pycolmap.TwoViewGeometryConfiguration, kind).value
    inliers = found.inlier_matches[:, 0]
    assert (inliers < true).sum() > 0.98 * true
    assert (inliers >= true).sum() < 0.1 * false
    assert len(np.unique(inliers)) == len(inliers)


def test_few_true_matches_are_found_with_a_known_lens():
    found = verify_matches(*scene(60, 120, camera(True)), max_error=4.0)
    assert (found.inlier_matches[:, 0] < 60).sum() > 55


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("true", [60, 900])
def test_flat_scenes_and_turned_cameras_are_recognised(true, known):
    for given in ({"flat": True}, {"moved": (0.0, 0.0, 0.0)}):
        found = verify_matches(*scene(true, true // 4, camera(known), **given), max_error=4.0)
        assert found.config in FLAT
        assert (found.inlier_matches[:, 0] < true).sum() > 0.95 * true


def test_false_matches_are_rejected():
    for false in (0, 10, 60):
        assert not len(verify_matches(*scene(0, false, camera()), max_error=4.0).inlier_matches)


def test_lenses_without_an_image_plane():
    found = verify_matches(*scene(200, 100, camera(True, "SIMPLE_RADIAL_FISHEYE")), max_error=4.0)
    assert (found.inlier_matches[:, 0] < 200).sum() > 190


def test_the_inlier_ratio_cannot_lose_a_pair():
    ratios = {count: _inlier_ratio(count) for count in (0, 15, 18, 30, 47, 5000)}
    assert list(ratios.values()) == [0.9, 0.9, 0.8, 0.5, 0.25, 0.25]
    assert all(r * count <= 15 or r == _INLIER_RATIOS[-1] for count, r in ratios.items())
