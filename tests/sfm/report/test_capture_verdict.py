"""The verdict on photos: each rule with and without its reason."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from snowsplat.evaluation.verdict import Reason, Verdict
from snowsplat.sfm.report.capture_verdict import capture_verdict, recorded_verdict
from snowsplat.sfm.report.coverage import Coverage, measure_coverage
from snowsplat.util.messages import message

CAPTURES = Path(__file__).resolve().parents[4] / "shared" / "captures"


def coverage(
    count: int = 50,
    confirmed: float = 0.75,
    step: float = 0.07,
    directions: float = 40.0,
    at_a_place: int = 1,
) -> Coverage:
    names = [f"{i:02d}.jpg" for i in range(count)]
    measures = (np.full(count, value) for value in (confirmed, step, directions))
    return Coverage(names, *measures, place=np.arange(count) // at_a_place * at_a_place)


def sfm(count: int = 50, lost: int = 0, **more: Any) -> dict[str, Any]:
    return {
        "registered": [f"{i:02d}.jpg" for i in range(count)],
        "unregistered": {f"lost {i}.jpg": "blurred" for i in range(lost)},
        "sub_models": [count],
        "reprojection_error": 0.5,
    } | more


def told(verdict: Verdict) -> str:
    return "\n".join(str(reason.text) for reason in verdict.reasons)


def test_good_photos():
    verdict = capture_verdict(coverage(), sfm(), {})
    assert verdict.grade == "good"
    assert (
        told(verdict) == "50 photos; in a typical one, 75% of the points are in at least two others"
    )


@pytest.mark.parametrize(
    ("measures", "facts", "grade", "words"),
    [
        ({"step": 0.25}, {}, "usable", "typically 25% of the distance to the scene away"),
        ({"step": 0.6}, {}, "poor", "typically 60% of the distance"),
        ({"count": 36, "at_a_place": 3}, {"registered": [""] * 36}, "usable", "from 12 places"),
        ({"count": 90, "at_a_place": 3}, {"registered": [""] * 90}, "good", "from 30 places"),
        ({"step": np.inf}, {}, "poor", "have no other photo that shows the same"),
        ({"confirmed": 0.4}, {}, "poor", "60% of the points are in only one other photo"),
        ({"count": 11}, {}, "usable", "11 photos are few"),
        ({"count": 5}, {}, "poor", "5 photos are too few"),
        ({}, {"lost": 2}, "good", "50 photos;"),
        ({}, {"lost": 10}, "usable", "10 of 60 photos could not be placed"),
        ({}, {"lost": 30, "sub_models": [50, 20]}, "poor", "the photos form 2 groups"),
        ({}, {"reprojection_error": 2.5}, "usable", "the reprojection error is high: 2.5 pixels"),
        ({}, {"doubts": ["the lens is odd"]}, "usable", "the lens is odd"),
        ({}, {"doubts": ["it is bent"], "agreement": 0.92}, "usable", "it is bent"),
        ({}, {"doubts": ["it is bent"], "agreement": 0.8}, "poor", "it is bent"),
        ({"directions": 8.0}, {}, "good", "the scene can be seen from there only"),
    ],
)
def test_reasons(measures, facts, grade, words):
    verdict = capture_verdict(coverage(**measures), sfm(**facts), {})
    assert verdict.grade == grade
    assert words in told(verdict)


def test_few_photos_of_one_side_are_enough_if_they_are_close():
    assert capture_verdict(coverage(20, step=0.04, directions=8.0), sfm(20), {}).grade == "good"
    assert capture_verdict(coverage(20, step=0.15, directions=8.0), sfm(20), {}).grade == "usable"


def test_a_model_without_observations_has_no_reasons_about_them():
    unknown = coverage(confirmed=np.nan, step=np.inf)
    assert capture_verdict(unknown, sfm(), {}).grade == "good"


def test_bad_photos_count_if_they_are_many():
    assert capture_verdict(coverage(), sfm(), {"01.jpg": "blurred"}).grade == "good"
    bad = {f"{i:02d}.jpg": "blurred" for i in range(14)} | {"20.jpg": "dark"}
    verdict = capture_verdict(coverage(), sfm(), bad)
    assert verdict.grade == "usable"
    assert told(verdict) == "14 of 50 photos: each is blurred"
    assert list(map(str, verdict.advice)) == ["hold the camera still, or take it in more light"]


def test_weak_ends_of_the_path_are_named():
    measures = coverage()
    measures.confirmed[-1] = 0.3
    verdict = capture_verdict(measures, sfm(), {})
    assert verdict.grade == "good"
    assert "most of what 49.jpg shows, at the end of your path" in told(verdict)


def test_the_verdict_is_read_from_the_record_of_a_dataset(tmp_path):
    assert recorded_verdict(tmp_path) is None
    verdict = Verdict.of([Reason("poor", message("far"), message("closer"))])
    record = {"stages": {"report": {"result": {"verdict": verdict.as_json()}}}}
    (tmp_path / "sfm.json").write_text(json.dumps(record))
    assert recorded_verdict(tmp_path) == verdict
    (tmp_path / "sfm.json").write_text('{"stages": []}')
    assert recorded_verdict(tmp_path) is None


@pytest.mark.parametrize(("name", "grade"), [("fern", "good"), ("fox_small", "good")])
def test_real_datasets(name, grade):
    model = CAPTURES / name / "sparse" / "0"
    if not model.is_dir():
        pytest.skip(f"no real dataset at ../shared/captures/{name}")
    measures = measure_coverage(model)
    assert capture_verdict(measures, sfm(len(measures.names)), {}).grade == grade


def test_what_was_lost_with_little_effort_may_be_found_with_more():
    few = sfm(20, unregistered={f"{i:02}.jpg": "" for i in range(20)})
    advice = {
        effort: str(capture_verdict(coverage(20), few, {}, effort).advice[0])
        for effort in ("draft", "normal", "best")
    }
    assert advice["draft"].startswith("try the quality normal")
    assert advice["normal"].startswith("try the quality best")
    assert advice["best"].startswith("take more photos between")
