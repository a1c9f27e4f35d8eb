"""Whether further attempts to estimate poses are made."""

import time
from types import SimpleNamespace

import pytest

from snowsplat.sfm.colmap.features import Folders, WorkerProgress
from snowsplat.sfm.colmap.lens import Lens
from snowsplat.sfm.colmap.options import SfmOptions
from snowsplat.sfm.colmap.reconstruct import PoseEstimation
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
    job = PoseEstimation(Folders(tmp_path), [], options, 1, progress)
    job.started = time.monotonic() - elapsed
    job.attempts = [SimpleNamespace(registered=registered)]
    assert job._enough(SimpleNamespace(usable=10)) == enough


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
    job = PoseEstimation(Folders(tmp_path), [], SfmOptions(), 1, progress)
    job.attempts = [
        SimpleNamespace(registered=n, agreement=share, error=1.0, lens=Lens())
        for n, share in attempts
    ]
    assert job._good(SimpleNamespace(usable=10)) == good
    assert job._best() is job.attempts[best]


def test_a_model_of_the_wrong_kind_of_lens_has_larger_errors(tmp_path):
    job = PoseEstimation(Folders(tmp_path), [], SfmOptions(), 1, WorkerProgress(silent))
    fisheye = Lens(fisheyes=frozenset([1]))
    job.attempts = [
        SimpleNamespace(registered=9, agreement=0.95, error=0.24, lens=fisheye),
        SimpleNamespace(registered=10, agreement=0.99, error=0.62, lens=Lens()),
    ]
    assert job._best() is job.attempts[0]
    job.attempts[1].error = 0.25
    assert job._best() is job.attempts[1]
