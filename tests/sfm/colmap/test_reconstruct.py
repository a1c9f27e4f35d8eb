"""Whether further attempts to estimate poses are made."""

import time
from types import SimpleNamespace

import pytest

from snowsplat.sfm.colmap.features import Folders, WorkerProgress
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
    progress = WorkerProgress(silent, lambda *table: None)
    options = SfmOptions(seconds=seconds)
    job = PoseEstimation(Folders(tmp_path), [], options, 1, progress)
    job.started = time.monotonic() - elapsed
    job.attempts = [SimpleNamespace(registered=registered)]
    assert job._enough(SimpleNamespace(usable=10)) == enough
