"""The estimate of the time that a stage still needs."""

import io

import pytest

from snowsplat.cli import observer
from snowsplat.cli.observer import StageProgress


class Clock:
    now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(observer, "time", clock)
    return clock


def last_line(clock, *reports) -> str:
    """The line after reports of one stage: seconds since the previous one, done, total, [left]."""
    stream = io.StringIO()
    report = StageProgress(stream=stream).begin("poses")
    for seconds, done, total, *left in reports:
        clock.now += seconds
        report(done, total, "photos", *left)
    return stream.getvalue().splitlines()[-1]


def test_the_rest_takes_as_long_per_item(clock):
    assert last_line(clock, (0, 0, 100), (30, 25, 100)) == "poses     25/100 photos  90 s left"


def test_items_that_were_finished_before_take_no_time(clock):
    """Photos are registered again: 80 of 100 have kept their poses."""
    line = last_line(clock, (0, 0, 100), (30, 100, 100), (60, 80, 100), (30, 90, 100))
    assert line == "poses     90/100 photos  30 s left"


def test_without_a_finished_item_there_is_no_estimate(clock):
    assert last_line(clock, (0, 80, 100), (30, 80, 100)) == "poses     80/100 photos"


def test_a_reported_time_left_is_shown(clock):
    assert last_line(clock, (0, 0, 100), (30, 25, 100, 400.0)) == (
        "poses     25/100 photos  6 min 40 s left"
    )
    assert last_line(clock, (30, 100, 100, 20.0)) == "poses     100/100 photos  20 s left"
