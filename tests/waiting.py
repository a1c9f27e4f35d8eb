"""Waiting for what another process or thread does."""

import time
from collections.abc import Callable


def wait_until(true: Callable[[], object], seconds: float = 60.0, pause: float = 0.02) -> None:
    """Wait until a condition holds. Only a defect reaches the limit of ``seconds``."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "what the test waits for has not happened"
        time.sleep(pause)
