"""Photos are registered in the order of their strongest pairs."""

import sqlite3
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from snowsplat.sfm.colmap.database import VerifiedPair, closing_database
from snowsplat.sfm.colmap.mapping import mapping as mapping_module
from snowsplat.sfm.colmap.mapping.incremental import _Growth
from snowsplat.sfm.colmap.mapping.view_graph import ViewGraph

from .. import look_alikes
from ..checks.test_repair import largest_centre_error, mapping_of, state_of

pytestmark = pytest.mark.sfm

EVERY = set(range(1, look_alikes.COUNT + 1))
UNORDERED = [f"{letter}.png" for letter in "qwertzuiopasdfgh"]


@pytest.fixture(scope="module")
def scene():
    return look_alikes.walk()


@pytest.fixture
def mapping(tmp_path, scene):
    return mapping_of(tmp_path, scene)


@pytest.fixture
def quick(tmp_path):
    """With fewer points."""
    return mapping_of(tmp_path, look_alikes.walk(1600))


def test_a_walk_past_look_alikes_without_an_order(mapping, scene):
    rows = [(name, i) for i, name in enumerate(UNORDERED, start=1)]
    with closing(sqlite3.connect(mapping.database)) as connection, connection:
        connection.executemany("UPDATE images SET name = ? WHERE image_id = ?", rows)
    (model,) = mapping.run("incremental")
    assert set(model.reg_image_ids()) == EVERY
    assert largest_centre_error(model, scene) < 0.05


def test_a_part_of_the_photos_is_registered_first(mapping, scene, monkeypatch):
    """The other photos are then registered without bundle adjustment."""
    monkeypatch.setattr(mapping_module, "photos_with_adjustment", lambda count: count // 2)
    calls = []
    grow = mapping_module.IncrementalMapper.grow

    def spy(self, model, photos, adjust):
        calls.append((len(photos), adjust))
        grow(self, model, photos, adjust)

    monkeypatch.setattr(mapping_module.IncrementalMapper, "grow", spy)
    (model,) = mapping.run("incremental")
    assert calls == [(11, True), (16, False)]
    assert set(model.reg_image_ids()) == EVERY
    assert largest_centre_error(model, scene) < 0.05


def test_registration_without_bundle_adjustment_changes_no_pose(quick):
    graph = ViewGraph.read(quick.database)
    mapper = quick._mapper(graph, relaxed=False)
    model = mapper.start(graph.names)
    mapper.grow(model, range(1, 9), adjust=True)
    before = {i: model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()}
    assert set(before) == set(range(1, 9))
    mapper.grow(model, graph.names, adjust=False)
    assert set(model.reg_image_ids()) == EVERY
    for photo, pose in before.items():
        assert np.array_equal(model.image(photo).cam_from_world().matrix(), pose)


def test_a_model_starts_with_other_photos_each_time(quick):
    graph = ViewGraph.read(quick.database)
    mapper = quick._mapper(graph, relaxed=False)
    first, second = (set(mapper.start(graph.names).reg_image_ids()) for _ in range(2))
    assert len(first) == len(second) == 2
    assert first != second


def test_the_photos_of_a_small_model_are_available_for_a_large_one(mapping, scene, monkeypatch):
    """The first pair was unsuitable, so a model ended with three photos in the middle of a walk."""
    grow = mapping_module.IncrementalMapper.grow
    starts = []

    def stopped(self, model, photos, adjust):
        if adjust:
            starts.append(set(model.reg_image_ids()))
        if len(starts) == 1:
            first = min(starts[0])
            photos = {first, first + 1, first + 2} | starts[0]
        grow(self, model, photos, adjust)

    monkeypatch.setattr(mapping_module.IncrementalMapper, "grow", stopped)
    (model,) = mapping.run("incremental")
    assert set(model.reg_image_ids()) == EVERY
    assert largest_centre_error(model, scene) < 0.05
    assert len(starts) == 2
    assert not starts[0] & starts[1]


def test_photos_of_another_place_make_another_model(quick):
    with closing_database(quick.database) as database:
        for i in range(1, 9):
            for j in range(9, 17):
                if database.exists_two_view_geometry(i, j):
                    database.delete_two_view_geometry(i, j)
    models = quick.run("incremental")
    assert sorted(sorted(model.reg_image_ids()) for model in models) == [
        list(range(1, 9)),
        list(range(9, 17)),
    ]


def test_equal_runs_give_equal_models(mapping, scene):
    first, second = (mapping.run("incremental")[0] for _ in range(2))
    assert set(first.reg_image_ids()) == EVERY
    assert largest_centre_error(first, scene) < 0.05
    assert state_of(first) == state_of(second)


def test_photos_that_follow_each_other_come_first_then_those_with_the_most_matches():
    names = {1: "IMG_1.jpg", 2: "IMG_2.jpg", 3: "IMG_3.jpg", 8: "x.jpg", 9: "y.jpg"}
    pairs = [(1, 2, 14), (1, 3, 20), (1, 8, 500), (1, 9, 900), (3, 8, 2000)]
    growth = SimpleNamespace(
        graph=ViewGraph.from_pairs(names, [VerifiedPair(*pair) for pair in pairs]),
        model=SimpleNamespace(reg_image_ids=lambda: [1]),
    )
    assert _Growth._in_order(growth, [2, 3, 8, 9]) == [3, 9, 8, 2]


def test_the_first_photos_follow_each_other(quick):
    """Pairs of photos with a larger angle and more matches may be look-alikes."""
    graph = ViewGraph.read(quick.database)
    pair = quick._mapper(graph, relaxed=False).start(graph.names).reg_image_ids()
    assert abs(pair[0] - pair[1]) <= 2
