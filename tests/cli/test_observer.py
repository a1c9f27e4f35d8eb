"""`TerminalObserver`: notes during a training run."""

import io
import sys

import pytest

from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.step_progress import StepProgress


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
