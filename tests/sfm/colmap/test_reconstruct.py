"""Whether further attempts to estimate poses are made."""

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
def test_attempts_end_early_if_time_is_short(tmp_path, seconds, elapsed, registered, enough):
    progress = WorkerProgress(silent)
    options = SfmOptions(seconds=seconds)
    job = PoseEstimation(DatasetFolder(tmp_path), [], options, 1, progress)
    job.started = time.monotonic() - elapsed
    job.attempts = [SimpleNamespace(registered=registered)]
    job.evidence = SimpleNamespace(usable=10)
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
def test_a_bent_model_is_not_good(tmp_path, attempts, good, best):
    progress = WorkerProgress(silent)
    job = PoseEstimation(DatasetFolder(tmp_path), [], SfmOptions(), 1, progress)
    job.attempts = [
        SimpleNamespace(
            registered=n, agreement=share, error=1.0, lens=Lens(), doubts=[], misfit=1.0
        )
        for n, share in attempts
    ]
    job.evidence = SimpleNamespace(usable=10)
    assert job._good == good
    assert best_attempt(job.attempts) is job.attempts[best]


def test_a_model_of_the_wrong_kind_of_lens_has_larger_errors(tmp_path):
    job = PoseEstimation(DatasetFolder(tmp_path), [], SfmOptions(), 1, WorkerProgress(silent))
    fisheye = Lens(fisheyes=frozenset([1]))
    job.attempts = [
        SimpleNamespace(registered=n, agreement=share, error=e, lens=lens, doubts=[], misfit=e)
        for n, share, e, lens in ((9, 0.95, 0.24, fisheye), (10, 0.99, 0.62, Lens()))
    ]
    assert best_attempt(job.attempts) is job.attempts[0]
    job.attempts[1].error = 0.25
    assert best_attempt(job.attempts) is job.attempts[1]


def test_a_lens_that_contradicts_exif_has_to_agree_better_with_the_matches(tmp_path):
    """A few photos of a flat field: with a wrong focal length, the poses are bent."""
    job = PoseEstimation(DatasetFolder(tmp_path), [], SfmOptions(), 1, WorkerProgress(silent))
    job.attempts = [
        SimpleNamespace(registered=5, agreement=0.79, error=0.69, misfit=1.10e-3, lens=Lens()),
        SimpleNamespace(registered=5, agreement=0.75, error=0.61, misfit=1.00e-3, lens=Lens()),
    ]
    bent, other = job.attempts
    bent.doubts, other.doubts = ["the focal length in EXIF does not agree with the photos"], []
    assert best_attempt(job.attempts) is other
    other.misfit = 1.2e-3  # the photos contradict the focal length in EXIF
    assert best_attempt(job.attempts) is bent


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
    tmp_path, monkeypatch, doubts, known, exif, tried
):
    """Even if the poses agree with the matches: a bent model of a street may."""
    monkeypatch.setattr(reconstruct, "exif_focals", lambda photos: known)
    job = PoseEstimation(DatasetFolder(tmp_path), [], SfmOptions(), 1, WorkerProgress(silent))
    job.attempts = [
        SimpleNamespace(
            registered=9, agreement=0.95, error=1.0, lens=Lens(), doubts=doubts, misfit=1.0
        )
    ]
    job.lens = Lens(exif=exif)
    assert job._contradicts_exif() == tried
