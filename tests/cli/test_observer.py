"""`TerminalObserver`: notes during a training run."""

import io
import sys
from types import SimpleNamespace

import pytest

from snowsplat.cli.observer import StepProgress, TerminalObserver


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
