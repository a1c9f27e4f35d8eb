"""The description of the machine."""

import contextlib
import getpass
import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import snowsplat
from snowsplat.util.machine import (
    memory_bytes,
    peak_bytes,
    processor_name,
    reset_peak,
    resident_bytes,
    system_name,
)


def test_machine():
    assert len(processor_name()) > 3
    assert processor_name() == processor_name().strip()
    assert memory_bytes() == 0 or memory_bytes() > 1 << 28
    assert system_name().startswith(platform.system())
    assert platform.python_version().startswith(system_name().split()[-1])


def test_no_user_or_host_name():
    text = f"{processor_name()} {system_name()}"
    names = [platform.node(), os.environ.get("HOSTNAME", "")]
    with contextlib.suppress(OSError, KeyError):
        names.append(getpass.getuser())
    assert not [name for name in names if len(name) > 3 and name in text]


SOURCES = Path(snowsplat.__file__).parents[1]


def test_the_peak_of_a_process_does_not_include_its_parent() -> None:
    """On Linux, the peak from getrusage includes the memory of the parent at the start."""
    held = np.ones(50_000_000)  # 400 MB
    code = "from snowsplat.util.machine import peak_bytes; print(peak_bytes())"
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
