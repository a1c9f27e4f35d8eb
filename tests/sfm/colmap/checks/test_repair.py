"""Photos in a wrong place are found, registered again, or left out with a reason."""

import sqlite3
from contextlib import closing

import numpy as np
import pycolmap
import pytest
import torch

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.scene.geometry import similarity_from_points
from snowsplat.sfm.colmap.attempt import AttemptRunner, Matched
from snowsplat.sfm.colmap.checks.consistency import CheckedPair, check_pairs
from snowsplat.sfm.colmap.checks.repair import _false_pairs, _parts, repair
from snowsplat.sfm.colmap.database import closing_database, copy_for_mapping, verified_pairs
from snowsplat.sfm.colmap.features.extraction import WorkerProgress
from snowsplat.sfm.colmap.lenses.lens import Lens
from snowsplat.sfm.colmap.mapping.mapping import Mapping
from snowsplat.sfm.colmap.options import EFFORTS
from snowsplat.sfm.colmap.pairs.choice import PairChoice
from snowsplat.sfm.progress import silent

from .. import look_alikes

pytestmark = pytest.mark.sfm

FAR = {i + 1 for i in look_alikes.FAR}


@pytest.fixture(scope="module")
def scene():
    return look_alikes.walk(1600)


def mapping_of(folder, scene):
    database = look_alikes.write_database(folder / "database.db", scene)
    return Mapping(database, folder, 1.0, 1, silent)


@pytest.fixture
def mapping(tmp_path, scene):
    return mapping_of(tmp_path, scene)


@pytest.fixture
def made_anew(monkeypatch):
    """A new model is made at once; the wrong photos are not first registered again."""
    monkeypatch.setattr("snowsplat.sfm.colmap.checks.repair._registered_again", lambda *_: [])


def state_of(model):
    poses = {i: model.image(i).cam_from_world().matrix().tolist() for i in model.reg_image_ids()}
    points = {i: (p.xyz.tolist(), str(p.track)) for i, p in model.points3D.items()}
    return poses, points


def largest_centre_error(model, scene):
    ids = sorted(model.reg_image_ids())
    found = torch.tensor(np.stack([model.image(i).projection_center() for i in ids]))
    truth = torch.tensor(scene.centres[[i - 1 for i in ids]])
    return float((similarity_from_points(found, truth).apply(found) - truth).norm(dim=1).max())


def test_a_correct_model_is_not_changed(mapping, scene):
    """The look-alikes are tears of the correct model, but the other matches confirm the places."""
    model = look_alikes.model(scene, folded=False)
    before = state_of(model)
    pairs = check_pairs(model, mapping.database, 4.0)
    assert sum(pair.torn for pair in pairs) > 5
    repaired = repair(model, mapping, 4.0)
    assert repaired.model is model
    assert state_of(model) == before
    assert (repaired.contradicting, repaired.excluded, repaired.description) == (0, {}, "")


@pytest.mark.parametrize("anew", [False, True], ids=["in the model", "in a new model"])
def test_a_folded_part_is_registered_again(mapping, scene, monkeypatch, anew):
    wrong = "_registered_again" if anew else "_made_again"
    monkeypatch.setattr(f"snowsplat.sfm.colmap.checks.repair.{wrong}", lambda *_: [])
    model = look_alikes.model(scene, folded=True)
    assert largest_centre_error(model, scene) > 5
    repaired = repair(model, mapping, 4.0)
    assert repaired.contradicting == len(FAR)
    assert repaired.excluded == {}
    assert (
        repaired.description
        == "the poses of 7 contradicted their matches: 7 registered again, 0 left out"
    )
    assert set(repaired.model.reg_image_ids()) == set(range(1, look_alikes.COUNT + 1))
    assert largest_centre_error(repaired.model, scene) < 0.05


def test_false_observations_hardly_move_the_cameras(tmp_path):
    """They are displaced in the same direction. With squared errors, the result is 0.0043."""
    scene = look_alikes.walk()
    mapping = mapping_of(tmp_path, scene)
    model = look_alikes.model(scene, folded=False)
    random = np.random.default_rng(1)
    for image_id in model.reg_image_ids():
        for point in model.image(image_id).points2D:
            if image_id > 8 and point.has_point3D() and random.uniform() < 0.15:
                point.xy += [0.0, 2.0]
    refined = mapping.without(model, [])
    assert refined.num_reg_images() == look_alikes.COUNT
    assert largest_centre_error(refined, scene) < 0.0025


def test_photos_that_follow_each_other_by_name(mapping, scene):
    pairs = check_pairs(look_alikes.model(scene, folded=True), mapping.database, 4.0)
    follow = {(pair.first, pair.second) for pair in pairs if pair.follows}
    assert follow == {(i + 1, j + 1) for i, j in scene.matches if j - i <= 2}


def test_which_pairs_between_parts_have_false_matches():
    """All pairs except tears, and except photos that follow each other."""
    torn, confirmed = CheckedPair(1, 4, 300, 0), CheckedPair(1, 5, 300, 200)
    following = CheckedPair(3, 4, 300, 200, follows=True)
    inside = CheckedPair(1, 2, 300, 200)
    assert _false_pairs([torn, confirmed, following, inside], [{1, 2, 3}, {4, 5}]) == {(1, 5)}


def test_pairs_that_were_false_before_count_only_if_photos_in_order_are_torn():
    """Two equal objects: after the repair, pairs with false matches contradict the true poses."""

    def pairs(last):
        true = [CheckedPair(i, i + 1, 500, 450, follows=True) for i in range(1, 20) if i != 10]
        true += [CheckedPair(10, 11, 54, last, follows=True)]
        true += [CheckedPair(9, 11, 24, last // 2, follows=True)]
        return true + [CheckedPair(i, i + 10, 2000, 0) for i in range(1, 11)]

    apart = [set(range(1, 11)), set(range(11, 21))]
    false_pairs = {(i, i + 10) for i in range(1, 11)}
    assert _parts(pairs(last=50), set()) == apart
    assert _parts(pairs(last=50), false_pairs) == [set(range(1, 21))]
    assert _parts(pairs(last=0), false_pairs) == apart


def test_a_part_that_cannot_be_registered_is_left_out_with_a_reason(
    mapping, scene, monkeypatch, made_anew
):
    monkeypatch.setattr(Mapping, "run", lambda self, mapper: [])
    repaired = repair(look_alikes.model(scene, folded=True), mapping, 4.0)
    assert set(repaired.excluded) == {f"{i - 1:02}.png" for i in FAR}
    assert set(repaired.model.reg_image_ids()).isdisjoint(FAR)
    reason = str(repaired.excluded["09.png"])
    assert reason.startswith(
        "it was, with other photos (7 in all), in a place that its matches contradict"
    )
    assert "09.png" in reason
    assert "but only 0 points in common" in reason
    assert (
        repaired.description
        == "the poses of 7 contradicted their matches: 0 registered again, 7 left out"
    )


def test_photos_that_the_mapper_drops_are_named(mapping, scene, monkeypatch, tmp_path, made_anew):
    """A model of COLMAP does not contain photos that have no matches with others any more."""

    def drop(self, mapper):
        model = self.without(look_alikes.model(scene, folded=False), FAR)
        (tmp_path / "registered").mkdir()
        model.write(tmp_path / "registered")
        return [pycolmap.Reconstruction(tmp_path / "registered")]

    monkeypatch.setattr(Mapping, "run", drop)
    repaired = repair(look_alikes.model(scene, folded=True), mapping, 4.0)
    assert set(repaired.model.images).isdisjoint(FAR)
    assert set(repaired.excluded) == {f"{i - 1:02}.png" for i in FAR}


def test_what_still_contradicts_at_the_end_is_left_out(mapping, scene, monkeypatch, made_anew):
    made = []

    def fold_again(self, mapper):
        made.append(look_alikes.model(scene, folded=True))
        return made[-1:]

    monkeypatch.setattr(Mapping, "run", fold_again)
    repaired = repair(look_alikes.model(scene, folded=True), mapping, 4.0)
    assert len(made) == 3
    assert repaired.model is made[-1]
    assert set(repaired.model.reg_image_ids()).isdisjoint(FAR)
    assert len(repaired.excluded) == len(FAR)


def test_a_photo_may_be_in_a_later_model_only(mapping, scene, monkeypatch, tmp_path, made_anew):
    first = mapping.without(look_alikes.model(scene, folded=True), [look_alikes.COUNT])
    first.write(tmp_path)
    first = pycolmap.Reconstruction(tmp_path)
    assert look_alikes.COUNT not in first.images
    folded = look_alikes.model(scene, folded=True)
    runs = iter([[folded], []])
    monkeypatch.setattr(Mapping, "run", lambda self, mapper: next(runs))
    repaired = repair(first, mapping, 4.0)
    assert f"{look_alikes.COUNT - 1:02}.png" in repaired.excluded


def test_the_model_with_the_most_photos_is_used(mapping, scene, monkeypatch, made_anew):
    """A model made again may have fewer photos than the first one without its wrong photos."""
    few = look_alikes.COUNT - len(FAR) - 1

    def small(self, mapper):
        photos = range(few + 1, look_alikes.COUNT + 1)
        return [self.without(look_alikes.model(scene, folded=False), photos)]

    monkeypatch.setattr(Mapping, "run", small)
    folded = look_alikes.model(scene, folded=True)
    repaired = repair(folded, mapping, 4.0)
    assert repaired.model is folded
    assert repaired.model.num_reg_images() == few + 1


def test_an_attempt_is_checked_and_described(mapping, scene, monkeypatch, tmp_path):
    folded = look_alikes.model(scene, folded=True)
    runs = iter([[folded], []])  # of the attempt, and of the repair
    monkeypatch.setattr(Mapping, "run", lambda self, mapper: next(runs))
    monkeypatch.setattr(Mapping, "extend", lambda self, models, relaxed=True: models)
    progress = WorkerProgress(silent)
    photos = look_alikes.photos()
    runner = AttemptRunner(DatasetFolder(tmp_path), photos, "auto", 1, progress)
    choice = PairChoice(sorted(scene.matches), "neighbours")
    matched = Matched(mapping.database, EFFORTS["draft"], choice, 1.0)
    attempt = runner.run("as configured", matched, "global", Lens("SIMPLE_PINHOLE"))
    assert attempt.registered == len(photos) - len(FAR)
    assert len(attempt.excluded) == len(FAR)
    assert attempt.description.endswith(
        "9 of 16 photos registered; the poses of 7 contradicted their matches: "
        "0 registered again, 7 left out"
    )


def test_the_copy_for_the_mapper_is_a_database_without_some_pairs(mapping, scene, tmp_path):
    copy = tmp_path / "copy.db"
    copy_for_mapping(mapping.database, copy, without=[(1, 2), (3, 4)])
    left = {(pair.first, pair.second) for pair in verified_pairs(copy)}
    assert left == {(i + 1, j + 1) for i, j in scene.matches} - {(1, 2), (3, 4)}
    with closing_database(copy) as database:
        assert database.num_images() == look_alikes.COUNT
        assert np.array_equal(
            database.read_two_view_geometry(2, 3).inlier_matches, scene.matches[1, 2]
        )
        assert database.num_keypoints() == sum(map(len, scene.pixels))


def test_the_database_is_not_changed(mapping, scene):
    def rows():
        with closing(sqlite3.connect(mapping.database)) as connection:
            return list(connection.iterdump())

    before = rows()
    repair(look_alikes.model(scene, folded=True), mapping, 4.0)
    assert rows() == before
    assert [path.name for path in mapping.database.parent.iterdir()] == ["database.db"]
