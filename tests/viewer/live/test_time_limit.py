"""The server's share of a core while it is in the process that trains."""

import asyncio
from types import SimpleNamespace

import pytest

from snowsplat.viewer.live import viewer
from snowsplat.viewer.live.viewer import ServerTimeLimit


class Clock:
    """Seconds of the clock, and of the processor in this thread."""

    now = used = 100.0

    def __init__(self) -> None:
        self.called: list[object] = []

    def call_later(self, seconds: float, measure: object) -> None:
        self.called.append(measure)
        self.sleep(seconds)

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def work(self, seconds: float) -> None:
        self.now += seconds
        self.used += seconds


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock()
    fake = SimpleNamespace(
        monotonic=lambda: clock.now, thread_time=lambda: clock.used, sleep=clock.sleep
    )
    monkeypatch.setattr(viewer, "time", fake)
    monkeypatch.setattr(asyncio, "get_running_loop", lambda: clock)
    return clock


@pytest.mark.parametrize("training", [True, False])
def test_a_busy_server_has_a_fifth_of_a_core_during_training(clock, training):
    limit = ServerTimeLimit(lambda: training)
    limit.measure()
    begun, used = clock.now, clock.used
    for _ in range(50):
        clock.work(0.03)
        limit.measure()
    share = (clock.used - used) / (clock.now - begun)
    assert share == pytest.approx(0.2 if training else 0.03 / 0.08, rel=0.03)


def test_a_pause_is_at_most_a_second(clock):
    limit = ServerTimeLimit(lambda: True)
    limit.measure()
    clock.work(10.0)
    before = clock.now
    limit.measure()
    assert clock.now - before == pytest.approx(1.0 + viewer._MEASURED_EVERY)
    assert clock.called == [limit.measure] * 2


def test_work_for_the_training_is_not_counted(clock):
    limit = ServerTimeLimit(lambda: True)
    limit.measure()
    before = clock.now
    for _ in range(2):
        with limit.uncounted():
            clock.work(0.01)
    clock.work(0.1)
    limit.measure()
    assert clock.now - before == pytest.approx(0.1 / 0.2)
