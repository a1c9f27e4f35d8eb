"""`TerminalObserver`: notes during a training run."""

import io
import sys
from types import SimpleNamespace

import pytest

from snowsplat.cli import observer
from snowsplat.cli.observer import StageProgress, StepProgress, TerminalObserver


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("quiet", [False, True])
def test_a_note_during_the_steps_is_printed_once(capsys, quiet):
    with TerminalObserver(quiet) as observer:
        observer.steps_begin(0, 10)
        observer.note("1 photo is left out: a.jpg")
    assert capsys.readouterr().out == ("" if quiet else "1 photo is left out: a.jpg\n")


def test_a_line_above_the_bar_is_printed_as_it_is():
    """Brackets are not markup, and a long line is not broken."""
    terminal, line = Terminal(), "left out: photo [b].jpg, " + 30 * "photo.jpg, "
    progress = StepProgress(10, stream=terminal)
    progress.say(line)
    progress.close()
    assert line in terminal.getvalue()


@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
def test_a_wait_is_shown_in_a_terminal_only(stream, monkeypatch):
    shown = stream()
    monkeypatch.setattr(sys, "stdout", shown)
    with TerminalObserver() as observer, observer.waiting("reading"):
        pass
    assert ("reading" in shown.getvalue()) == (stream is Terminal)


def test_a_remote_shell_gets_the_command_that_forwards_the_port(capsys, monkeypatch):
    """The line is that of `snowsplat view`, and only pages of this computer alone need it."""
    page = SimpleNamespace(url="http://127.0.0.1:8081/token/", others=[])
    for variable, expected in (("SSH_CONNECTION", True), ("", False)):
        for name in ("SSH_CONNECTION", "SSH_TTY"):
            monkeypatch.delenv(name, raising=False)
        if variable:
            monkeypatch.setenv(variable, "1")
        TerminalObserver().page_opened(page)
        out = capsys.readouterr().out
        assert out.startswith("watch it in a browser: http://127.0.0.1:8081/token/\n")
        assert ("from your computer: ssh -L 8081:127.0.0.1:8081 " in out) == expected
    page = SimpleNamespace(url="http://localhost:8081/token/", others=["http://box:8081/token/"])
    monkeypatch.setenv("SSH_TTY", "1")
    TerminalObserver().page_opened(page)
    assert capsys.readouterr().out.endswith("from other computers: http://box:8081/token/\n")


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
