"""Deferred Ctrl-C, and the signals that mean the same."""

import os
import pty
import signal
import subprocess
import sys
import threading
from collections.abc import Callable

import pytest

from snowsplat.util.interrupts import (
    ask_to_end,
    ended_by_signals,
    ended_together,
    interrupts_between_steps,
    of_own_group,
    raise_deferred_interrupt,
)


@pytest.fixture(autouse=True)
def _default_actions():
    """Also if the tests were started with nohup: then SIGHUP is ignored, and in child processes."""
    numbers = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, signal.SIG_DFL) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


def press() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def done_before_interrupt(*actions: Callable[[], None]) -> int:
    """Number of actions that finish before KeyboardInterrupt is raised."""
    done = 0
    try:
        with interrupts_between_steps():
            for action in actions:
                action()
                done += 1
    except KeyboardInterrupt:
        return done
    raise AssertionError("no KeyboardInterrupt was raised")


def test_ctrl_c_is_deferred_until_interrupts_are_allowed():
    raise_deferred_interrupt()
    assert (
        done_before_interrupt(
            raise_deferred_interrupt, press, lambda: None, raise_deferred_interrupt, press
        )
        == 3
    )
    raise_deferred_interrupt()  # nothing is pending any more
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_ctrl_c_is_not_deferred():
    assert done_before_interrupt(press, press) == 1


def test_the_function_of_the_context_raises_a_deferred_ctrl_c():
    with interrupts_between_steps() as raise_deferred:
        raise_deferred()
        press()
        with pytest.raises(KeyboardInterrupt):
            raise_deferred()


def test_a_deferred_ctrl_c_is_dropped_at_the_end_of_the_context():
    with interrupts_between_steps():
        press()
    raise_deferred_interrupt()


def test_nothing_is_deferred_in_other_threads():
    found = []

    def run() -> None:
        with interrupts_between_steps() as raise_deferred:
            raise_deferred()
            found.append(True)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [True]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_that_ends_the_program_counts_once_as_ctrl_c(number, monkeypatch):
    monkeypatch.setattr("snowsplat.util.interrupts._leave_terminal", lambda: None)

    def send() -> None:
        os.kill(os.getpid(), number)

    with ended_by_signals():
        assert done_before_interrupt(send, send, lambda: None, raise_deferred_interrupt) == 3
        send()  # while the scene is saved
    with pytest.raises(KeyboardInterrupt), ended_by_signals():
        send()
    assert signal.getsignal(number) is signal.SIG_DFL


def test_a_signal_that_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with ended_by_signals():
            os.kill(os.getpid(), signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_ctrl_break_is_what_ends_a_process_of_windows(monkeypatch):
    """No Windows was seen: its names are those of the documentation of Python."""
    monkeypatch.setattr(signal, "SIGBREAK", signal.SIGUSR1, raising=False)
    with pytest.raises(KeyboardInterrupt), ended_by_signals():
        os.kill(os.getpid(), signal.SIGUSR1)
    sent = []
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(signal, "CTRL_BREAK_EVENT", 1, raising=False)
    monkeypatch.setattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 512, raising=False)
    monkeypatch.setattr(os, "kill", lambda *how: sent.append(how))
    ask_to_end(77)
    assert sent == [(77, 1)]
    assert of_own_group() == {"creationflags": 512}


def test_a_process_of_its_own_group_is_asked_to_end():
    code = "import time; from snowsplat.util.interrupts import ended_by_signals\n"
    code += "with ended_by_signals():\n try: print('begun', flush=True); time.sleep(60)\n"
    code += " except KeyboardInterrupt: print('saved')"
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, **of_own_group()
    )
    with process:
        assert process.stdout.readline() == "begun\n"
        assert os.getpgid(process.pid) == process.pid
        ask_to_end(process.pid)
        assert process.stdout.read() == "saved\n"
    ask_to_end(process.pid)  # it has ended


def test_a_child_gets_the_signal():
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        with pytest.raises(KeyboardInterrupt), ended_by_signals(), ended_together(child):
            os.kill(os.getpid(), signal.SIGTERM)
        assert child.wait(10) == -signal.SIGTERM


def test_a_closed_terminal_does_not_hinder_saving(tmp_path):
    """After it is closed, all writes to it fail."""
    code = f"""
import time
from pathlib import Path
from snowsplat.util.interrupts import ended_by_signals
with ended_by_signals():
    try:
        print("begun", flush=True)
        while True:
            time.sleep(0.05)
    except KeyboardInterrupt:
        print("saving", flush=True)
        Path({str(tmp_path / "saved")!r}).touch()
"""
    process, terminal = pty.fork()
    if process == 0:
        os.execv(sys.executable, [sys.executable, "-c", code])
    assert os.read(terminal, 1) == b"b"
    os.close(terminal)
    os.waitpid(process, 0)
    assert (tmp_path / "saved").exists()


def test_pycolmap_does_not_take_the_signal():
    code = """
import os, signal
from snowsplat.util.interrupts import ended_by_signals
with ended_by_signals():
    import snowsplat.sfm.colmap
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    except KeyboardInterrupt:
        print("as Ctrl-C")
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ended.stdout, ended.stderr) == ("as Ctrl-C\n", "")
