"""Whether further attempts to estimate poses are made, and which of them is the best."""

import time
from types import SimpleNamespace

import pytest

from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.sfm.colmap import reconstruct
from snowsplat.sfm.colmap.features.extraction import WorkerProgress
from snowsplat.sfm.colmap.lenses.lens import Lens
from snowsplat.sfm.colmap.reconstruct import PoseEstimation, best_attempt
from snowsplat.sfm.options import SfmOptions
from snowsplat.sfm.progress import silent


def attempt(registered, agreement=0.99, error=1.0, misfit=1.0, lens=None, doubts=()):
    return SimpleNamespace(
        registered=registered,
        agreement=agreement,
        error=error,
        misfit=misfit,
        lens=lens or Lens(),
        doubts=doubts,
    )


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
    ("attempts", "good", "best"),
    [
        ([(9, 0.99)], True, 0),
        ([(9, 0.8)], False, 0),  # enough photos, but the model is bent
        ([(10, 0.8), (10, 0.99)], True, 1),
        ([(10, 0.8), (4, 0.99)], False, 0),
    ],
)
def test_a_bent_model_is_not_good(job, attempts, good, best):
    job.attempts = [attempt(*each) for each in attempts]
    assert job._good == good
    assert best_attempt(job.attempts) is job.attempts[best]


def test_a_model_of_the_wrong_kind_of_lens_has_larger_errors():
    fisheye = attempt(9, 0.95, 0.24, 0.24, Lens(fisheyes=frozenset([1])))
    ordinary = attempt(10, 0.99, 0.62, 0.62)
    assert best_attempt([fisheye, ordinary]) is fisheye
    ordinary.error = 0.25
    assert best_attempt([fisheye, ordinary]) is ordinary


def test_a_lens_that_contradicts_exif_has_to_agree_better_with_the_matches():
    """A few photos of a flat field: with a wrong focal length, the poses are bent."""
    bent = attempt(5, 0.79, 0.69, 1.10e-3, doubts=["the focal length in EXIF does not agree"])
    other = attempt(5, 0.75, 0.61, 1.00e-3)
    assert best_attempt([bent, other]) is other
    other.misfit = 1.2e-3  # the photos contradict the focal length in EXIF
    assert best_attempt([bent, other]) is bent


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
    assert job._contradicts_exif() == tried
