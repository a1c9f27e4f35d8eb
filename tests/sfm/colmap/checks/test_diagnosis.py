"""The explanation of a failure, from the numbers of features and matches."""

import itertools

import pytest

from snowsplat.sfm.colmap.checks import diagnosis
from snowsplat.sfm.colmap.checks.diagnosis import Evidence, explain, failure, gather_evidence
from snowsplat.sfm.colmap.database import VerifiedPair
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.util.messages import Message


def photos(count):
    return [Photo(f"{i}.jpg", f"{i}.jpg", 640, 480, "") for i in range(count)]


def all_pairs(count, inliers=200, flat=False):
    return [
        VerifiedPair(i, j, inliers, flat=flat)
        for i, j in itertools.combinations(range(1, count + 1), 2)
    ]


def test_each_photo_without_a_pose_has_its_own_reason():
    features = [2000, 2000, 2000, 12, 2000, 2000, 2000, 2000, 2000, 2000]
    pairs = [VerifiedPair(1, 2, 300), VerifiedPair(1, 6, 22), VerifiedPair(3, 6, 18)]
    pairs += [VerifiedPair(2, 7, 400), VerifiedPair(8, 9, 90)]
    evidence = Evidence(features, pairs, 0.2, 36)
    models = [{"0.jpg", "1.jpg", "2.jpg"}, {"7.jpg", "8.jpg"}]
    wrong = {"9.jpg": Message("its place is wrong")}
    found = explain(photos(10), evidence, models, wrong)
    reasons = {photo: str(why) for photo, why in found.items()}
    assert list(reasons) == [f"{i}.jpg" for i in (3, 4, 5, 6, 7, 8, 9)]
    assert "hardly any detail (12 features)" in reasons["3.jpg"]
    assert reasons["4.jpg"] == "it matches no other photo"
    assert reasons["5.jpg"] == "it has too few matches with 2 other photos (at most 22)"
    assert reasons["6.jpg"] == "its matches with 1 other photo are not consistent with the model"
    assert "a separate group of 2 photos" in reasons["7.jpg"]
    assert reasons["9.jpg"] == "its place is wrong"


@pytest.mark.parametrize(
    ("evidence", "message"),
    [
        (Evidence([0] * 5, [], None, 10), "only 0 of 5 show enough detail"),
        (Evidence([0, 2000, 2000, 3], [VerifiedPair(2, 3, 99)], 0.1, 6), "only 2 of 4 show enough"),
        (Evidence([2000] * 5, [], None, 10), "no two of them match"),
        (Evidence([2000] * 5, [VerifiedPair(1, 5, 80)], 0.1, 10), "only 2 of them match"),
        (Evidence([2000] * 5, all_pairs(5, flat=True), 0.001, 10), "camera hardly moved"),
        (Evidence([2000] * 5, all_pairs(5, flat=True), 0.1, 10), "only rotated"),
        (Evidence([2000] * 5, all_pairs(5), 0.1, 10), "too few or inconsistent"),
    ],
)
def test_failure_has_a_reason_and_advice(evidence, message):
    text = str(failure(evidence))
    assert "\n" not in text
    assert text.count(";") == 1
    with pytest.raises(type(failure(evidence)), match=message):
        raise failure(evidence)


def test_more_effort_is_useless_without_overlap_or_motion():
    assert Evidence([0] * 5, [], None, 10).more_effort_is_useless
    assert Evidence([2000] * 5, [], None, 10).more_effort_is_useless
    assert not Evidence([2000] * 5, [], None, 4).more_effort_is_useless  # not all pairs matched
    # With so few features, more effort may find more of them.
    assert not Evidence([300] * 5, [], None, 10).more_effort_is_useless
    assert not Evidence([2000] * 5, all_pairs(5), 0.1, 10).more_effort_is_useless
    assert Evidence([2000] * 5, all_pairs(5), 0.001, 10).more_effort_is_useless
    assert Evidence([2000] * 5, all_pairs(5, flat=True), 0.1, 10).more_effort_is_useless


def test_brackets_from_one_place_do_not_say_that_the_scene_is_flat(monkeypatch, tmp_path):
    """Three exposures at a place: 3 pairs without motion, 9 with depth."""
    pairs = [VerifiedPair(i, j, 900, flat=True) for i, j in ((1, 2), (1, 3), (2, 3))]
    pairs += [VerifiedPair(i, j, 60) for i, j in itertools.product((1, 2, 3), (4, 5, 6))]
    monkeypatch.setattr(diagnosis, "verified_pairs", lambda _: pairs)
    monkeypatch.setattr(diagnosis, "feature_counts", lambda *_: [2000] * 6)
    monkeypatch.setattr(
        diagnosis, "displacements_of", lambda _, some, still: [100.0 * (not p.flat) for p in some]
    )
    evidence = gather_evidence(tmp_path, photos(6), 15)
    assert not evidence.flat
