"""From counts of features and matches to a reason in words."""

import itertools

import pytest

from snowsplat.sfm.colmap.database import Pair
from snowsplat.sfm.colmap.diagnosis import Evidence, explain, failure
from snowsplat.sfm.ingest.photo import Photo


def photos(count):
    return [
        Photo(f"{i}.jpg", f"{i}.jpg", 640, 480, "", None, None, None, False, False)
        for i in range(count)
    ]


def all_pairs(count, inliers=200, flat=False):
    return [Pair(i, j, inliers, flat) for i, j in itertools.combinations(range(count), 2)]


def test_each_photo_that_is_missing_has_its_own_reason():
    features = [2000, 2000, 2000, 12, 2000, 2000, 2000, 2000, 2000]
    pairs = [Pair(0, 1, 300, False), Pair(0, 5, 22, False), Pair(2, 5, 18, False)]
    pairs += [Pair(1, 6, 400, False), Pair(7, 8, 90, False)]
    evidence = Evidence(features, pairs, 0.2, 36)
    reasons = explain(photos(9), evidence, [{"0.jpg", "1.jpg", "2.jpg"}, {"7.jpg", "8.jpg"}])
    assert list(reasons) == [f"{i}.jpg" for i in (3, 4, 5, 6, 7, 8)]
    assert "hardly any detail (12 points)" in reasons["3.jpg"]
    assert reasons["4.jpg"] == "it matches no other photo"
    assert reasons["5.jpg"] == "it matches only 2 other photos, weakly (at most 22 points)"
    assert reasons["6.jpg"] == "its matches with 1 other photo do not fit the rest"
    assert "another part of 2 photos" in reasons["7.jpg"]


@pytest.mark.parametrize(
    ("evidence", "message"),
    [
        (Evidence([0] * 5, [], None, 10), "too few of the 5 photos have detail"),
        (Evidence([0, 2000, 2000, 3], [Pair(1, 2, 99, False)], 0.1, 6), r"detail to go by \(2\)"),
        (Evidence([2000] * 5, [], None, 10), "no two of them match"),
        (Evidence([2000] * 5, [Pair(0, 4, 80, False)], 0.1, 10), "only 2 of them match"),
        (Evidence([2000] * 5, all_pairs(5, flat=True), 0.001, 10), "camera hardly moved"),
        (Evidence([2000] * 5, all_pairs(5, flat=True), 0.1, 10), "only turned on the spot"),
        (Evidence([2000] * 5, all_pairs(5), 0.1, 10), "do not fit together"),
    ],
)
def test_failure_says_what_is_wrong_and_what_to_do(evidence, message):
    text = str(failure(evidence))
    assert "\n" not in text
    assert text.count(";") == 1
    with pytest.raises(type(failure(evidence)), match=message):
        raise failure(evidence)


def test_hopeless_is_what_more_features_do_not_mend():
    assert Evidence([0] * 5, [], None, 10).hopeless
    assert Evidence([2000] * 5, [], None, 10).hopeless
    assert not Evidence([2000] * 5, [], None, 4).hopeless  # not all were compared
    assert not Evidence([300] * 5, [], None, 10).hopeless  # few features: more may match
    assert not Evidence([2000] * 5, all_pairs(5), 0.1, 10).hopeless
    assert Evidence([2000] * 5, all_pairs(5), 0.001, 10).hopeless
    assert Evidence([2000] * 5, all_pairs(5, flat=True), 0.1, 10).hopeless


def test_photos_without_hope_do_not_count():
    evidence = Evidence([2000, 2000, 2000, 10, 2000], all_pairs(3), 0.1, 10)
    assert evidence.hopeful == 3
