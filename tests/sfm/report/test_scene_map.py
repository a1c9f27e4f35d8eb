"""The drawing of cameras and points: correct positions, no outliers, fast."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import torch

from snowsplat.scene.geometry import look_at
from snowsplat.sfm.report.scene_map import PlacedPhoto, draw_scene

SVG = "{http://www.w3.org/2000/svg}"
UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


def placed(centre, target=(0.0, 0.0, 0.0), name="a.jpg", sequence=None) -> PlacedPhoto:
    position, aim = (torch.tensor(v, dtype=torch.float64) for v in (centre, target))
    return PlacedPhoto(name, sequence, look_at(position, aim, UP).numpy(), 0.6, 0.4)


def ring(count: int, sequence: str | None = None) -> list[PlacedPhoto]:
    angles = np.arange(count) * 2 * np.pi / count
    return [
        placed((3 * np.sin(a), -1.0, -3 * np.cos(a)), name=f"{i}.jpg", sequence=sequence)
        for i, a in enumerate(angles)
    ]


def cloud(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return random.normal(size=(count, 3)) * 0.5, random.integers(0, 256, (count, 3), np.uint8)


def frusta(root: ET.Element) -> dict[str, np.ndarray]:
    """(8, 2) corners and centre of each camera's path, by the photo's name."""
    found = {}
    for path in root.iter(f"{SVG}path"):
        title = path.find(f"{SVG}title")
        if title is not None:
            numbers = re.findall(r"-?[\d.]+", path.attrib["d"])
            found[title.text] = np.array(numbers, float).reshape(-1, 2)
    return found


def dots(root: ET.Element) -> np.ndarray:
    """(n, 2) positions of all points."""
    paths = [p.attrib["d"] for p in root.iter(f"{SVG}path") if "h0" in p.attrib["d"]]
    pairs = [pair for d in paths for pair in re.findall(r"M(-?[\d.]+) (-?[\d.]+)h0", d)]
    return np.array(pairs, float).reshape(-1, 2)


def test_the_top_is_forward_in_one_view_and_up_in_the_other():
    photos = [
        placed((0.0, 0.0, -3.0), name="near"),
        placed((0.0, 0.0, 3.0), name="far"),
        placed((3.0, 0.0, 0.0), name="right"),
        placed((0.0, -3.0, -0.5), name="high"),
    ]
    above, side = (ET.fromstring(d.svg) for d in draw_scene(photos, *cloud(100)))
    eye = {name: corners[5] for name, corners in frusta(above).items()}
    assert eye["far"][1] < eye["near"][1]
    assert eye["right"][0] > eye["near"][0]
    assert eye["far"][0] == pytest.approx(eye["near"][0], abs=0.2)
    eye = {name: corners[5] for name, corners in frusta(side).items()}
    assert eye["high"][1] < eye["near"][1]
    assert eye["far"][0] > eye["near"][0]
    # The scale is the same in both directions and both drawings.
    lengths = [
        np.linalg.norm(frusta(view)["far"][5] - frusta(view)["near"][5]) for view in (above, side)
    ]
    assert lengths[0] == pytest.approx(lengths[1], abs=0.3)


def test_frusta_show_the_viewing_direction():
    above = ET.fromstring(
        draw_scene([placed((0.0, 0.0, -3.0)), placed((3.0, 0.0, 0.0), name="r")], *cloud(100))[
            0
        ].svg
    )
    for name, ahead in (("a.jpg", (0, -1)), ("r", (-1, 0))):
        corners = frusta(above)[name]
        direction = corners[:4].mean(axis=0) - corners[5]
        assert np.allclose(direction / np.linalg.norm(direction), ahead, atol=0.02)


def test_every_camera_is_inside_and_outliers_are_not_drawn():
    xyz, rgb = cloud(2000)
    xyz[:20] *= 1e4
    photos = ring(30)
    for drawing in draw_scene(photos, xyz, rgb):
        root = ET.fromstring(drawing.svg)
        width, height = map(float, root.attrib["viewBox"].split()[2:])
        assert drawing.width == width
        assert max(width, height) <= 520.5
        shown = frusta(root)
        assert sorted(shown) == sorted(photo.name for photo in photos)
        for corners in (*shown.values(), dots(root)):
            assert (corners > -1).all()
            assert (corners < [width + 1, height + 1]).all()
        assert 1500 < len(dots(root)) <= 1980
        # The outliers did not change the scale of the drawing.
        spread = np.ptp(np.array([c[5] for c in shown.values()]), axis=0)
        assert spread.max() > 0.5 * max(width, height)


def test_points_keep_their_colours():
    xyz, _ = cloud(50)
    red = np.tile(np.array([255, 0, 0], np.uint8), (50, 1))
    root = ET.fromstring(draw_scene(ring(5), xyz, red)[0].svg)
    strokes = {p.attrib["stroke"] for p in root.iter(f"{SVG}path") if "h0" in p.attrib["d"]}
    assert strokes == {"#ff2d2d"}


def test_the_path_of_a_video_is_drawn_but_not_of_photos():
    lines = [
        list(ET.fromstring(draw_scene(ring(8, sequence), *cloud(50))[0].svg).iter(f"{SVG}polyline"))
        for sequence in ("walk <1>.mp4", None)
    ]
    assert len(lines[0]) == 1
    assert len(lines[0][0].attrib["points"].split(" ")) == 16
    assert lines[0][0].find(f"{SVG}title").text == "walk <1>.mp4"
    assert not lines[1]


@pytest.mark.parametrize("photos", [[placed((0.0, 0.0, -3.0))], [placed((0.0, 0.0, -3.0))] * 3])
def test_a_single_position_without_points(photos):
    for drawing in draw_scene(photos, np.empty((0, 3)), np.empty((0, 3), np.uint8)):
        root = ET.fromstring(drawing.svg)
        assert "nan" not in drawing.svg
        assert len(list(root.iter(f"{SVG}title"))) == len(photos)


def test_a_large_scene_has_a_small_drawing():
    drawings = draw_scene(ring(1000), *cloud(300_000))
    assert sum(len(d.svg) for d in drawings) < 1_000_000
