"""`ServerTimeLimit`: a server in the process that trains must not slow it down."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterator

_SHARE = 0.2  # share of a core that the server uses
_LONGEST_PAUSE = 1.0  # seconds for which the server is paused at a time
_TICK = 0.05  # seconds between two measurements of the server's processor time


class ServerTimeLimit:
    """Limits the share of a core that the thread of a server uses during training."""

    def __init__(self, training: Callable[[], bool]) -> None:
        """``training``: whether the limit holds at present."""
        self._training = training
        # At the last measurement, in seconds: processor time of the thread, and the clock.
        self._used = self._measured = 0.0
        self._uncounted = 0.0  # processor time since then that is not counted, in seconds

    def measure(self) -> None:
        """Begin; it runs in the event loop of the server, and pauses its thread if necessary."""
        used = time.thread_time() - self._used - self._uncounted
        pause = used / _SHARE - (time.monotonic() - self._measured)
        if self._measured and pause > 0.0 and self._training():
            time.sleep(min(pause, _LONGEST_PAUSE))
        self._used, self._measured, self._uncounted = time.thread_time(), time.monotonic(), 0.0
        asyncio.get_running_loop().call_later(_TICK, self.measure)

    @contextlib.contextmanager
    def uncounted(self) -> Iterator[None]:
        """A context for work that the training has started: its time is not limited."""
        before = time.thread_time()
        try:
            yield
        finally:
            self._uncounted += time.thread_time() - before
