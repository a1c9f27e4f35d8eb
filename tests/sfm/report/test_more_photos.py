"""Where more photos would help, for cameras around a subject and in a row."""

import numpy as np
import pytest
import torch

from snowsplat.scene.geometry import look_at
from snowsplat.sfm.report.more_photos import advice
from snowsplat.sfm.report.scene_map import PlacedPhoto

UP = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)


def photo(centre, target=(0.0, 0.0, 0.0)) -> PlacedPhoto:
    pose = look_at(torch.tensor(centre).double(), torch.tensor(target).double(), UP)
    return PlacedPhoto("a", None, pose.numpy(), 0.5, 0.4)


def around(degrees) -> list[PlacedPhoto]:
    angles = np.radians(degrees)
    return [photo([3 * np.sin(a), -1.0, -3 * np.cos(a)]) for a in angles]


POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (2000, 3))


def test_no_gaps():
    found = advice(around(range(0, 360, 20)), POINTS)
    assert found.places.shape == (0, 3)
    assert found.seldom == 0.0


def test_a_gap_around_a_subject():
    found = advice(around(range(0, 300, 20)), POINTS)  # 80 degrees without a photo
    angles = np.degrees(np.arctan2(found.places[:, 0], -found.places[:, 2])) % 360
    assert sorted(angles.round()) == pytest.approx([300.0, 320.0, 340.0], abs=1.0)
    assert np.linalg.norm(found.places[:, [0, 2]], axis=1) == pytest.approx(3.0, abs=0.1)
    assert found.places[:, 1] == pytest.approx(-1.0)
    assert all("80° gap" in str(reason) for reason in found.reasons)


def test_photos_of_one_side_have_no_gap_behind_it():
    assert len(advice(around(range(-60, 61, 10)), POINTS).places) == 0
    flight = [photo([x, -4.0, z], target=(x, 0.0, z + 0.4)) for x in (-1, 0, 1) for z in (-1, 0, 1)]
    assert len(advice(flight, POINTS).places) == 0


def test_a_photo_far_from_the_others():
    centres = [-1.0, -0.9, -0.8, -0.7, -0.6, -0.5, 2.0]
    row = [photo([x, 0.0, -4.0], target=(x, 0.0, 0.0)) for x in centres]
    found = advice(row, np.empty((0, 3)))
    assert found.places.tolist() == [pytest.approx([0.75, 0.0, -4.0])]


def test_points_in_few_photos():
    many = around(range(0, 360, 30))
    aside = np.random.default_rng(1).uniform(-0.3, 0.3, (1000, 3)) + np.array([[0.0, -9.0, 0.0]])
    beside = [photo([0.0, -8.0, -3.0], target=(0.0, -9.0, 0.0))]
    found = advice(many + beside, np.concatenate([POINTS, aside]))
    assert 0.1 < found.seldom < 0.5
    assert any("few photos" in str(reason) for reason in found.reasons)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_photos(count):
    assert len(advice(around(range(count)), POINTS).places) == 0
