"""dataset_report.html is complete, self-contained and well-formed, for any file names."""

import base64
import io
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pycolmap
import pytest
import torch
from PIL import Image

from snowsplat.data.colmap.model import read_model, read_points, write_model
from snowsplat.evaluation.verdict import Reason, Verdict
from snowsplat.scene.geometry import look_at
from snowsplat.sfm.report import dataset_report
from snowsplat.sfm.report.dataset_report import write_report
from snowsplat.util.messages import message

from ...browser import chinese_labels, english_text

NAMES = [
    "one.jpg",
    "sub/zwei ñandú 雪.jpg",
    "a <b> & 'c' \"d\".png",
    *(f"{i:03d}.jpg" for i in range(27)),
]
UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory, model_of) -> Path:
    root = tmp_path_factory.mktemp("captures") / "mon <château>"
    angles = torch.arange(len(NAMES), dtype=torch.float64) * 0.2
    centres = torch.stack([4 * angles.sin(), -1 + 0 * angles, -4 * angles.cos()], 1)
    poses = torch.stack([look_at(centre, 0 * UP, UP) for centre in centres])
    points = torch.randn(3000, 3, generator=torch.Generator().manual_seed(0)) * 0.6
    camera = pycolmap.Camera(model="PINHOLE", width=160, height=120, params=[100, 100, 80, 60])
    (root / "sparse" / "0").mkdir(parents=True)
    model_of(poses, points, [camera], NAMES).write(root / "sparse" / "0")
    for name in NAMES:
        (root / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        image = Image.effect_noise((160, 120), 60.0).convert("RGB")
        if name.endswith("png"):
            image.putalpha(128)
        image.save(root / "images" / name)
    return root


def facts(**sfm: Any) -> dict[str, Any]:
    lens = {
        "model": "SIMPLE_RADIAL",
        "width": 160,
        "height": 120,
        "params": [100.0, 80.0, 60.0, 0.01],
        "focal_from": "guessed",
        "images": len(NAMES),
    }
    return {
        "inputs": ["/photos/mon <château>"],
        "settings": {"fps": None, "camera_model": "SIMPLE_RADIAL <i>"},
        "gathered": {
            "photos": [
                {"name": name, "sequence": "walk.mp4" if name[0] == "0" else None} for name in NAMES
            ],
            "left_out": [
                {
                    "photo": "/photos/bad <script>.jpg",
                    "stage": "photos",
                    "reason": "cannot be decoded",
                }
            ],
        },
        "sfm": {
            "registered": NAMES,
            "unregistered": {"lost & found.jpg": "too few points in common"},
            "points": 3000,
            "observations": 51234,
            "reprojection_error": 0.613,
            "sub_models": [len(NAMES)],
            "cameras": [lens],
            "pairs": "each with each",
            "attempts": ["incremental: 30 of 31 photos"],
        }
        | sfm,
        "undistorted": {"sizes": [[158, 118, 30]], "resampled": True},
        "seconds": {"photos": 3.21, "poses": 6000.0, "images": 130.0},
        "problems": {},
        "alone": True,
        "verdict": Verdict.of(
            [Reason("usable", message("30 photos < 31"), message("take <more>"))]
        ).as_json(),
    }


def test_page_is_well_formed_and_self_contained(dataset):
    page = write_report(dataset, facts())
    assert page == dataset / "dataset_report.html"
    text = page.read_text(encoding="utf-8")
    ET.fromstring(text)  # strict: the page is XML, too
    HTMLParser().feed(text)
    icon, *sources = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert icon == "data:,"
    assert sources
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert text.count("<script>") == 1  # that opens the pictures
    assert "url(" not in text


def test_page_reports_the_results(dataset):
    shown = english_text(write_report(dataset, facts()))
    for expected in (
        "mon <château>",
        "30 of 31 photos",
        "30 / 31",
        "3,000",
        "51,234",
        "0.61 px",
        "100 px (77°)",
        "1 h 40 min",
        "2 min 10 s",
        "3.2 s",
        "lost & found.jpg",
        "too few points in common",
        "bad <script>.jpg",
        "cannot be decoded",
        "each with each",
        "incremental: 30 of 31 photos",
        "158 × 118",
        "snowsplat train '",
        "The photos: usable, with limits",
        "30 photos < 31",
        "Take <more>",
    ):
        assert expected in shown


def with_notes(*notes: str) -> dict[str, Any]:
    known = facts()
    known["gathered"]["notes"] = notes
    return known


ZOOMS = "focal lengths of 455 and 727 pixels"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (with_notes("v <1>.mp4: bars: cut off"), ["Fixed to the frame: v <1>.mp4: bars: cut off"]),
        (
            facts() | {"problems": {NAMES[0]: "dark"}},
            [f"1 of {len(NAMES)} photos may be better", "is too dark; use more light"],
        ),
        (facts(sub_models=[30, 12, 4]), ["form 3 separate groups", "30, 12, 4 photos"]),
        (facts(unregistered={}), ["The poses of all 30 photos were found."]),
        (facts(zooms=ZOOMS), [f"The photos have {ZOOMS}"]),
        (facts(), ["snowsplat train '"]),  # a dataset of `make` needs no next step
    ],
    ids=["fixed", "problems", "groups", "all", "zooms", "alone"],
)
def test_what_is_told_only_with_a_reason(dataset, change, told):
    other = facts() | ({"alone": False} if change == facts() else {})
    usual, shown = (english_text(write_report(dataset, each)) for each in (other, change))
    for words in told:
        assert words in shown
        assert words not in usual


def test_all_cameras_appear_in_both_drawings(dataset):
    root = ET.parse(write_report(dataset, facts())).getroot()
    drawings = list(root.iter("{http://www.w3.org/2000/svg}svg"))
    assert len(drawings) == 2
    for drawing in drawings:
        titles = [title.text for title in drawing.iter("{http://www.w3.org/2000/svg}title")]
        assert sorted(titles) == sorted([*NAMES, "walk.mp4"])


def test_pictures_are_reduced_images(dataset, monkeypatch):
    monkeypatch.setattr(dataset_report, "_PICTURE_HEIGHT", 60)
    root = ET.parse(write_report(dataset, facts())).getroot()
    images = list(root.iter("img"))
    assert len(images) == 24
    assert {image.attrib["alt"] for image in images} <= set(NAMES)
    for image in images:
        with Image.open(io.BytesIO(base64.b64decode(image.attrib["src"].split(",")[1]))) as decoded:
            assert decoded.format == "JPEG"
            assert decoded.height == 60
    assert (dataset / "dataset_report.html").stat().st_size < 600_000


def test_gaps_are_numbered_in_the_drawing(dataset, tmp_path):
    """The cameras of the dataset surround the subject. Without some of them there is a gap."""
    assert "numbered places" not in english_text(write_report(dataset, facts()))
    gap = tmp_path / "gap"
    model = read_model(dataset / "sparse" / "0")
    kept = [image for i, image in enumerate(model.images) if not 8 <= i < 14]
    points = read_points(dataset / "sparse" / "0")
    write_model(gap / "sparse" / "0", model.cameras, kept, points.xyz.numpy(), points.rgb.numpy())
    page = write_report(gap, facts())
    words = english_text(page)
    assert "Take 3 more photos from the numbered places" in words
    assert "1 to 3no photo shows the subject from here" in words
    assert page.read_text().count('fill="#7cc7ff"') == 2 * 3  # in both drawings


def test_long_lists_are_shortened_and_any_name_is_accepted(dataset):
    lost = {f"p{i}\udcff\x07.jpg": "blurred" for i in range(900)}
    page = write_report(dataset, facts(unregistered=lost, reprojection_error=None))
    shown = english_text(page)
    assert "p199" in shown
    assert "p200" not in shown
    assert "and 701 more" in shown  # one of them is a photo that could not be decoded


def test_level_north_and_scale_are_told(dataset):
    """In metres, the scale bars name the unit too."""
    before = write_report(dataset, facts()).read_text()
    assert "<h2>Level, north" not in before
    assert re.search(r"[0-9] units</t", before)
    placement = {
        "up_from": [message("the <gimbal> angles of 18 photos").as_json()],
        "level_error": 0.7,
        "metres_per_unit": 1.0,
        "scale_from": message("GPS positions of {n} photos", n=18).as_json(),
        "scale_error": 0.026,
        "position_error": 1.2,
        "doubts": [message("GPS & gimbal disagree").as_json()],
    }
    record = facts()
    record["undistorted"]["placement"] = placement
    page = write_report(dataset, record)
    words, after = english_text(page), page.read_text()
    assert "from the <gimbal> angles of 18 photos, to about 0.7°" in words
    assert "scale from GPS positions of 18 photos (1.2 m typical error), to about 2.6%" in words
    assert "GPS & gimbal disagree" in words
    assert "units" not in words
    assert re.search(r"[0-9] m</text>", after)


@pytest.mark.browser
def test_headings_and_labels_are_chinese_in_a_browser_in_chinese(dataset):
    known = facts() | {"problems": {NAMES[0]: "dark"}}
    known["undistorted"]["placement"] = {
        "up_from": [message("the ground").as_json(), message("accelerometers").as_json()],
        "level_error": 0.7,
    }
    path = write_report(dataset, known)
    labels = chinese_labels(path)
    assert {"镜头", "个镜头"} <= set(labels)  # "Lenses", a heading, and "lens", after a number
