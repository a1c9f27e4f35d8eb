"""The verdict on a scene, from the metrics of held-out and training photos."""

import dataclasses
import math

import pytest

from snowsplat.data import load_dataset
from snowsplat.evaluation.metrics import Evaluation, ViewMetrics
from snowsplat.evaluation.verdict import Reason, Verdict
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.report.scene_verdict import scene_verdict
from snowsplat.util.messages import message


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("verdict")
    write_toy_dataset(folder, n_views=17, width=48, height=36, n_points=300)
    return load_dataset(folder, hold_out=4)


def evaluation(*explained: float, ssim: float = 0.9, contours: float = 0.5) -> Evaluation:
    """The PSNR is that of photos with a variance of 0.1."""
    names = [f"view_{4 * i:02d}.png" for i in range(len(explained))]
    values = [-10 * math.log10(max(0.1 * (1 - share), 1e-9)) for share in explained]
    return Evaluation(
        [
            ViewMetrics(name, psnr, ssim, psnr, None, share, contours)
            for name, psnr, share in zip(names, values, explained, strict=True)
        ]
    )


SHARP = evaluation(0.98, 0.98, 0.98, 0.98)


def told(verdict: Verdict) -> str:
    return "\n".join(str(reason.text) for reason in verdict.reasons)


@pytest.mark.parametrize(
    ("held_out", "trained_on", "grade", "words"),
    [
        (evaluation(0.95, 0.96, 0.97), SHARP, "good", "reproduces 96% of the contrast"),
        (evaluation(0.85, 0.86, 0.87), evaluation(0.9), "usable", "reproduces only 86%"),
        (evaluation(0.85, 0.86, 0.87), SHARP, "usable", "the error is 2.6 times"),
        (evaluation(0.7, 0.7, 0.7), SHARP, "poor", "the error is 3.9 times"),
        (evaluation(0.6, 0.6, 0.6), evaluation(0.8), "poor", "reproduces only 60%"),
        (evaluation(0.6, 0.6, 0.6, contours=0.8), SHARP, "usable", "but 80% of that of contours"),
        (evaluation(-0.2), evaluation(0.3), "poor", "0.3 of"),
        (evaluation(0.95, 0.96, 0.97, contours=0.3), SHARP, "usable", "only 30% of their"),
        (evaluation(0.95, 0.96, 0.97, ssim=0.6), SHARP, "usable", "blurred in held-out photos"),
        (evaluation(1.0), evaluation(1.0), "good", "reproduces 100%"),
    ],
)
def test_grades(dataset, held_out, trained_on, grade, words):
    verdict = scene_verdict(held_out, trained_on, dataset)
    assert verdict.grade == grade
    assert words.replace("0.3 of", "only 30% of the contrast of the photos") in told(verdict)


def test_the_worst_photos_are_named(dataset):
    verdict = scene_verdict(evaluation(0.95, 0.1, 0.97, 0.96), SHARP, dataset)
    assert verdict.grade == "usable"
    assert str(verdict.reasons[0].text).startswith("the scene looks wrong in view_04.png (10.5 dB)")
    # Other photos show most of this photo; but with one photo for training, hardly any does.
    assert "training photos" not in str(verdict.reasons[0].text)
    alone = load_dataset(dataset.train[0].image.path.parents[1], hold_out=4)
    alone.train = alone.train[:1]
    lonely = scene_verdict(evaluation(0.95, 0.1, 0.97, 0.96), SHARP, alone)
    assert "of what it shows is in at most two training photos" in str(lonely.reasons[0].text)


@pytest.mark.parametrize(
    ("photos", "points", "held_out", "trained_on", "advice"),
    [
        (12, True, evaluation(0.6, 0.6, 0.6), SHARP, "take more photos"),
        (301, True, evaluation(0.6, 0.6, 0.6), SHARP, "there are enough photos"),
        (301, True, evaluation(0.95, 0.1, 0.97), SHARP, "there are enough photos"),
        (301, False, evaluation(0.6, 0.6, 0.6), SHARP, "take more photos"),
        (12, True, evaluation(0.3), evaluation(0.3), "train longer; if"),
        (12, False, evaluation(0.3), evaluation(0.3), "add a point cloud"),
    ],
)
def test_the_advice_follows_from_the_evidence(
    dataset, photos, points, held_out, trained_on, advice
):
    views = (dataset.train * photos)[:photos]
    some = dataclasses.replace(dataset, train=views, points=dataset.points if points else None)
    verdict = scene_verdict(held_out, trained_on, some)
    assert advice in "".join(str(reason.advice) for reason in verdict.reasons)


def test_a_photo_without_contrast_is_not_wrong(dataset):
    """Of a white ceiling, errors of one grey level are all of the contrast."""
    ceiling = evaluation(0.95, 0.96, 0.97)
    ceiling.views[1] = ViewMetrics("view_04.png", 48.0, 0.99, 48.0, None, -1.0)
    assert "looks wrong" not in told(scene_verdict(ceiling, SHARP, dataset))


def test_what_the_training_has_found(dataset):
    good = evaluation(0.95, 0.96, 0.97)
    found = [Reason("good", message("1 photo was left out")), Reason("usable", message("off by 3"))]
    verdict = scene_verdict(good, SHARP, dataset, found)
    assert verdict.grade == "usable"
    assert str(verdict.reasons[0].text) == "off by 3"
    assert "1 photo was left out" in told(verdict)
    assert scene_verdict(good, SHARP, dataset, found[:1]).grade == "good"


@pytest.mark.parametrize(
    ("grade", "predicted", "held_out", "as_part_of"),
    [
        ("poor", False, evaluation(0.95), "poor"),
        ("poor", False, evaluation(0.95, 0.96, 0.97), "usable"),
        ("poor", True, evaluation(0.7), "poor"),
        ("poor", True, evaluation(0.8), "usable"),
        ("poor", True, evaluation(0.95, 0.96, 0.97), "usable"),
        ("usable", True, evaluation(0.95), "usable"),
        ("usable", True, evaluation(0.95, 0.96, 0.97), "good"),
        ("usable", True, evaluation(0.95, 0.96, 0.97, ssim=0.6), "usable"),
        ("usable", False, evaluation(0.95, 0.96, 0.97), "usable"),
        ("good", False, evaluation(0.5), "good"),
    ],
)
def test_the_verdict_on_the_photos_counts_but_held_out_photos_outweigh_it(
    dataset, grade, predicted, held_out, as_part_of
):
    of_photos = Reason(grade, message("photo"), message("move"), predicted)
    verdict = scene_verdict(held_out, SHARP, dataset, capture=Verdict.of([of_photos]))
    (reason,) = [each for each in verdict.reasons if str(each.text) == "photo"]
    assert reason.grade == as_part_of
    assert (reason.advice == message("move")) == (as_part_of != "good" or grade == "good")


def test_good_photos_do_not_make_a_scene_good_that_held_out_photos_contradict(dataset):
    nice = Verdict.of([Reason("good", message("50 photos"))])
    assert scene_verdict(evaluation(0.5), SHARP, dataset, capture=nice).grade == "poor"
