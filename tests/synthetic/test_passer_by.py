"""The person is in the chosen photos only, in front of what is behind, and at different places."""

import numpy as np
import pytest

from snowsplat.synthetic.photographer import phone_lens, walk
from snowsplat.synthetic.scene import Lamp, Scene, SceneObject
from snowsplat.synthetic.shapes import Box

from ..scenes.depth import depth_map
from ..scenes.passer_by import chosen_photos, passers_by, photograph

LENS = phone_lens(80, 60, distortion=(0.0, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def room() -> Scene:
    wall = np.full((16, 16, 3), 0.5, np.float32)
    box = Box((0, 0, 0.6), (5.0, 5.0, 2.8), inside=True)
    return Scene([SceneObject(box, [wall])], Lamp((0, 0, 1.9), (1.0, 1.0), 2.5, 0.6))


def test_chosen_photos_are_not_held_out():
    chosen = chosen_photos(48, 0.2, seed=0)
    assert len(chosen) == 10
    assert chosen == sorted(set(chosen))
    assert not [i for i in chosen if i % 8 == 0]
    assert chosen == chosen_photos(48, 0.2, seed=0) != chosen_photos(48, 0.2, seed=1)


def test_a_photo_with_the_person_differs_where_the_person_is(room):
    poses = walk(12, 0)
    people = passers_by([(1, poses[1]), (7, poses[7])], seed=3)
    assert set(people) == {1, 7}
    for i, person in people.items():
        empty, seen = (
            photograph(room, LENS, poses[i], np.random.default_rng(0), passing)
            for passing in (None, person)
        )
        visible = depth_map(person, LENS, poses[i]) < depth_map(room, LENS, poses[i])
        differs = np.abs(seen.astype(int) - empty).max(2) > 12
        assert 0.01 < visible.mean() < 0.4
        assert (differs & visible).sum() > 0.8 * visible.sum()
        assert (differs & ~visible).mean() < 0.02  # the edges, and noise


def test_the_person_stands_at_another_place_in_each_photo():
    pose = walk(12, 0)[1]
    first, second, again = (passers_by([(i, pose)])[i] for i in (1, 2, 1))
    maps = [depth_map(person, LENS, pose) for person in (first, second, again)]
    assert np.array_equal(maps[0], maps[2])
    assert not np.array_equal(maps[0], maps[1])
