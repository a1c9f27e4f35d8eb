"""Whether further attempts to estimate poses are made, and which of them is the best."""

import time
from types import SimpleNamespace

import pytest

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.colmap import reconstruct
from snowsplat.sfm.colmap.features.extraction import WorkerProgress
from snowsplat.sfm.colmap.lenses.lens import Lens
from snowsplat.sfm.colmap.reconstruct import PoseEstimation
from snowsplat.sfm.options import SfmOptions
from snowsplat.sfm.progress import silent


def attempt(registered, agreement=0.99, doubts=()):
    return SimpleNamespace(registered=registered, agreement=agreement, doubts=doubts, models=[])


@pytest.fixture
def job(tmp_path):
    """10 photos are usable."""
    job = PoseEstimation(DatasetFolder(tmp_path), [], SfmOptions(), 1, WorkerProgress(silent))
    job.evidence = SimpleNamespace(usable=10)
    return job


@pytest.mark.parametrize(
    ("seconds", "elapsed", "registered", "enough"),
    [
        (None, 1000.0, 8, False),
        (None, 0.0, 9, True),
        (90.0, 20.0, 8, False),  # the next attempt will end in time
        (90.0, 40.0, 8, True),  # it will not
        (90.0, 40.0, 0, False),  # without any pose, the time does not matter
    ],
)
def test_attempts_end_early_if_time_is_short(job, seconds, elapsed, registered, enough):
    job.options = SfmOptions(seconds=seconds)
    job.started = time.monotonic() - elapsed
    job.attempts = [attempt(registered)]
    assert job._enough == enough


@pytest.mark.parametrize(
    ("agreement", "again", "good"),
    [
        (0.99, False, True),
        (0.8, False, False),  # enough photos, but the model is bent
        (0.8, True, True),
    ],
)
def test_a_bent_model_is_not_good(job, agreement, again, good):
    job.attempts, job.again = [attempt(9, agreement)], again
    assert job._good == good


def test_the_attempt_with_the_highest_score_is_used(job):
    few, many = job.attempts = [attempt(9), attempt(10)]
    few.models = many.models = ["a model"]
    job.pairs, job.scores = [], [(few, SimpleNamespace(total=5)), (many, SimpleNamespace(total=4))]
    assert job._best() is few
    job.scores[0][1].total = 3
    assert job._best() is many


@pytest.mark.parametrize(
    ("doubts", "known", "exif", "tried"),
    [
        (["a focal length"], {1: 1035.0}, True, True),
        ([], {1: 1035.0}, True, False),
        (["a focal length"], {}, True, False),
        (["a focal length"], {1: 1035.0}, False, False),  # the matches have contradicted it
    ],
)
def test_the_focal_length_in_exif_is_held_if_the_lens_contradicts_it(
    job, monkeypatch, doubts, known, exif, tried
):
    """Even if the poses agree with the matches: a bent model of a street may."""
    monkeypatch.setattr(reconstruct, "exif_focals", lambda photos: known)
    job.attempts = [attempt(9, 0.95, doubts=doubts)]
    job.lens = Lens(exif=exif)
    assert job._contradicts_exif == tried


@pytest.mark.parametrize(
    ("agreement", "registered", "way"),
    [
        (0.99, 9, "own"),
        (0.80, 9, "separate"),  # a zoom in a clip, explained by an impossible walk
        (0.99, 5, "separate"),
    ],
)
def test_focal_lengths_of_a_bent_model_are_found_with_separate_cameras(
    job, monkeypatch, agreement, registered, way
):
    """Bundle adjustment of a bent model remains in it."""
    found = []
    groups = {
        "separate": lambda photos: photos,
        "focals_of": lambda model: "separate",
        "own_focals": lambda model, threads: "own",
        "group_by_zoom": lambda photos, focals: found.append(focals),
    }
    for name, function in groups.items():
        monkeypatch.setattr(reconstruct.camera_groups, name, function)
    monkeypatch.setattr(reconstruct, "set_cameras", lambda *about: None)
    mapping = SimpleNamespace(run=lambda mapper: ["a model"])
    monkeypatch.setattr(job.runner, "mapping", lambda matched, lens: mapping)
    job.matched, job.lens = SimpleNamespace(database=None), Lens()
    job.attempts = [attempt(registered, agreement)]
    job.attempts[0].models = ["a model"]
    job._try_zooms()
    assert found == [way]


@pytest.mark.parametrize("flat", [True, False])
def test_another_mapper_is_not_tried_before_a_plane(job, flat):
    job.evidence.flat, job.attempts = flat, [attempt(5)]
    job.attempts[0].models = ["a model"]
    other = next(c for c in reconstruct.CANDIDATES if c.make is PoseEstimation._try_other_mapper)
    assert other.sensible(job) != flat
