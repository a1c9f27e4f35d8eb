"""Photos are registered in the order of their strongest pairs, and not at look-alike places."""

import numpy as np
import pycolmap
import pytest

from snowsplat.sfm.colmap import mapping as mapping_module
from snowsplat.sfm.colmap.database import closing_database, set_names
from snowsplat.sfm.colmap.incremental import _contradicts
from snowsplat.sfm.colmap.mapping import Mapping
from snowsplat.sfm.colmap.view_graph import VerifiedPair, ViewGraph
from snowsplat.sfm.progress import silent

from . import look_alikes
from .test_repair import largest_centre_error, state_of

pytestmark = pytest.mark.sfm

EVERY = set(range(1, look_alikes.COUNT + 1))
UNORDERED = [f"{letter}.png" for letter in "qwertzuiopasdfgh"]


@pytest.fixture(scope="module")
def scene():
    return look_alikes.walk()


@pytest.fixture
def mapping(tmp_path, scene):
    database = look_alikes.write_database(tmp_path / "database.db", scene)
    return Mapping(database, tmp_path, 1.0, 1, silent)


@pytest.mark.parametrize("ordered", [True, False], ids=["numbered", "unordered"])
def test_a_walk_past_look_alikes(mapping, scene, ordered):
    if not ordered:
        set_names(mapping.database, UNORDERED)
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
    assert calls == [(8, True), (16, False)]
    assert set(model.reg_image_ids()) == EVERY
    assert largest_centre_error(model, scene) < 0.05


def test_registration_without_bundle_adjustment_changes_no_pose(mapping):
    graph = ViewGraph.read(mapping.database)
    mapper = mapping._mapper(graph, relaxed=False)
    model = mapper.start(graph.names)
    mapper.grow(model, range(1, 9), adjust=True)
    before = {i: model.image(i).cam_from_world().matrix() for i in model.reg_image_ids()}
    assert set(before) == set(range(1, 9))
    mapper.grow(model, graph.names, adjust=False)
    assert set(model.reg_image_ids()) == EVERY
    for photo, pose in before.items():
        assert np.array_equal(model.image(photo).cam_from_world().matrix(), pose)


def test_a_model_starts_with_other_photos_each_time(mapping):
    graph = ViewGraph.read(mapping.database)
    mapper = mapping._mapper(graph, relaxed=False)
    first, second = (set(mapper.start(graph.names).reg_image_ids()) for _ in range(2))
    assert len(first) == len(second) == 2
    assert first != second


def test_photos_of_another_place_make_another_model(mapping):
    with closing_database(mapping.database) as database:
        for i in range(1, 9):
            for j in range(9, 17):
                if database.exists_two_view_geometry(i, j):
                    database.delete_two_view_geometry(i, j)
    models = mapping.run("incremental")
    assert sorted(sorted(model.reg_image_ids()) for model in models) == [
        list(range(1, 9)),
        list(range(9, 17)),
    ]


def test_equal_runs_give_equal_models(mapping):
    first, second = (mapping.run("incremental")[0] for _ in range(2))
    assert state_of(first) == state_of(second)


@pytest.mark.parametrize("follows", [True, False])
def test_a_photo_is_not_registered_where_the_photo_before_it_contradicts(mapping, scene, follows):
    """Most matches of photo 14 are false: they are with points that look like those it shows."""
    model = look_alikes.model(scene, folded=False)
    observations = pycolmap.ObservationManager(model)
    for photo in range(10, 17):
        observations.deregister_frame(model.image(photo).frame_id)
    names = [f"{letter}.png" for letter in "abcdefghijklmnop"]
    if follows:  # photo 14 follows photo 9
        names[8], names[13] = "x1.png", "x2.png"
        _, one, two = np.intersect1d(scene.seen[8], scene.seen[13], return_indices=True)
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
        geometry.inlier_matches = np.stack([one, two], 1).astype(np.uint32)[:20]
        with closing_database(mapping.database) as database:
            database.write_two_view_geometry(9, 14, geometry)
    set_names(mapping.database, names)
    for photo, name in enumerate(names, start=1):
        model.image(photo).name = name
    mapper = mapping._mapper(ViewGraph.read(mapping.database), relaxed=False)
    mapper.grow(model, [14], adjust=False)
    assert (14 in model.reg_image_ids()) is not follows
    assert (largest_centre_error(model, scene) < 0.05) is follows


def test_when_a_pose_contradicts_the_matches():
    following = VerifiedPair(1, 2, 30, follows=True)
    equal_room = {VerifiedPair(1, other, 500): 1.0 for other in range(5, 15)}
    assert not _contradicts({})
    assert not _contradicts({following: 0.9, VerifiedPair(1, 9, 500): 0.0})
    assert _contradicts({following: 0.1, VerifiedPair(1, 9, 500): 1.0})
    assert _contradicts({following: 0.1, **equal_room})
    assert not _contradicts({following: 0.9, **equal_room})
    assert not _contradicts({VerifiedPair(1, 9, 49): 0.0})
    assert _contradicts({VerifiedPair(1, 9, 400): 0.0, VerifiedPair(1, 8, 200): 1.0})
