"""The memory of this process."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import snowsplat
from snowsplat.util.process_memory import peak_bytes, reset_peak, resident_bytes

SOURCES = Path(snowsplat.__file__).parents[1]


def test_the_peak_of_a_process_does_not_include_its_parent() -> None:
    """On Linux, the peak from getrusage includes the memory of the parent at the start."""
    held = np.ones(50_000_000)  # 400 MB
    code = "from snowsplat.util.process_memory import peak_bytes; print(peak_bytes())"
    environment = os.environ | {"PYTHONPATH": str(SOURCES)}
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert held.sum() > 0
    assert 0 < int(run.stdout) < 200_000_000


@pytest.mark.skipif(not os.access("/proc/self/clear_refs", os.W_OK), reason="only on Linux")
def test_the_peak_of_an_earlier_task_does_not_count():
    before = resident_bytes()
    earlier = np.ones(25_000_000)  # 200 MB
    del earlier
    assert peak_bytes() > before + 150_000_000
    reset_peak()
    assert peak_bytes() < before + 50_000_000
