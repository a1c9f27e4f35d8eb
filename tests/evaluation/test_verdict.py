"""The verdict: its grade, the order of its reasons, and its words."""

import json
import xml.etree.ElementTree as ET

import pytest

from snowsplat.evaluation.verdict import Reason, Verdict
from snowsplat.util.html import _environment
from snowsplat.util.messages import Message, message

MORE = message("take more")
REMARK = Reason("good", message("all photos show one side"))
FEW = Reason("usable", message("{count} photos are few", count=11), MORE)
FAR = Reason("poor", message("the photos are far apart <here>"), MORE)
LOST = Reason("usable", message("3 photos are lost"), message("take photos in between"))
PHOTOS = message("the photos")


def test_the_worst_reason_is_the_grade_and_comes_first():
    assert Verdict.of([]).grade == "good"
    assert Verdict.of([REMARK]).grade == "good"
    verdict = Verdict.of([REMARK, FEW, LOST, FAR])
    assert verdict.grade == "poor"
    assert verdict.reasons == (FAR, FEW, LOST, REMARK)
    assert verdict.told == (FAR, FEW, LOST)
    assert list(map(str, verdict.advice)) == ["take more", "take photos in between"]


def test_lines():
    assert Verdict.of([REMARK, FEW]).lines(PHOTOS) == [
        "the photos: usable, with limits",
        "  - 11 photos are few",
        "  also: all photos show one side",
        "  next time: take more",
    ]
    assert Verdict.of([REMARK]).lines(message("it")) == ["it: good", "  - all photos show one side"]


def box_of(verdict: Verdict, what: Message) -> ET.Element:
    """The box of a page, in English."""
    template = _environment().get_template("evaluation/verdict.html.j2")
    box = ET.fromstring(str(template.module.verdict_box(verdict, what)))
    for parent in list(box.iter()):
        for each in parent.findall("*[@lang='zh']"):
            parent.remove(each)
    return box


def test_the_box_of_a_page():
    words = [each.strip() for each in box_of(Verdict.of([REMARK, FEW]), PHOTOS).itertext()]
    assert "11 photos are few" in words
    assert "Also: all photos show one side" in words


def test_html_is_escaped():
    box = box_of(Verdict.of([FAR]), message("the scene"))
    assert box.attrib["class"] == "verdict poor"
    words = " ".join("".join(box.itertext()).split())
    assert words.startswith("The scene: poor; expect blurred or wrong parts")
    assert "The photos are far apart <here>" in words
    assert "Next time:Take more" in words


def test_json():
    verdict = Verdict.of([REMARK, FAR])
    assert Verdict.from_json(json.loads(json.dumps(verdict.as_json()))) == verdict


@pytest.mark.parametrize("values", [None, {}, [], {"reasons": 1}, {"reasons": [{"text": "no"}]}])
def test_other_json_is_no_verdict(values):
    assert Verdict.from_json(values) is None
