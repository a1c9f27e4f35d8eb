"""Ctrl-C during training, and the signals that end a program on a server in the same way."""

import os
import signal
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

# Set while the main thread defers interrupts, and while one is deferred.
_deferring = threading.Event()
_pending = threading.Event()
_children: list[subprocess.Popen[Any]] = []


def raise_deferred_interrupt(agree: Callable[[bool], bool] = bool) -> None:
    """Raise KeyboardInterrupt if a Ctrl-C is deferred; for code that waits between steps.

    ``agree``: combines whether a Ctrl-C is deferred in this process with the same in the others.
    """
    if agree(_pending.is_set()):
        raise KeyboardInterrupt


@contextmanager
def interrupts_between_steps() -> Iterator[Callable[..., None]]:
    """Defer Ctrl-C, and what `ended_by_signals` handles, until the function of this context is
    called.

    A second Ctrl-C is not deferred. Nothing is changed outside of the main thread, and for Ctrl-C
    if Python's own handler of SIGINT has been replaced.
    """

    def defer(*_: object) -> None:
        _pending.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    if threading.current_thread() is not threading.main_thread():
        yield lambda *_: None
        return
    handle_again()
    own = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if own:
        signal.signal(signal.SIGINT, defer)
    _deferring.set()
    try:
        yield raise_deferred_interrupt
    finally:
        _deferring.clear()
        _pending.clear()
        if own:
            signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the process as Ctrl-C does, so that what is finished is saved.

    SIGTERM comes from a service manager, a batch system or a container, SIGHUP from a terminal that
    is closed. On Windows, SIGBREAK is both, and what `ask_to_end` sends. Only the first one counts:
    several may come at once, and who is in a hurry sends SIGKILL. A signal that is ignored stays
    ignored (`nohup`).
    """
    is_main = threading.current_thread() is threading.main_thread()
    names = ("SIGTERM", "SIGHUP", "SIGBREAK") if is_main else ()
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    ours = [number for number in numbers if signal.getsignal(number) is signal.SIG_DFL]

    def end(number: int, _: object) -> None:
        for each in ours:
            signal.signal(each, lambda *_: None)
        if number != signal.SIGTERM:
            _leave_terminal()
        for child in _children if sys.platform != "win32" else ():  # there the group gets it
            child.send_signal(number)
        if not _deferring.is_set():
            raise KeyboardInterrupt
        _pending.set()

    for number in ours:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


def of_own_group() -> dict[str, Any]:
    """Arguments of `subprocess.Popen` for a process that outlives this one, for `ask_to_end`."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}


def ask_to_end(process: int) -> None:
    """Ask a process of `of_own_group` to save what it has and to end; see `ended_by_signals`.

    Windows has no SIGTERM: it would end at once, with nothing saved. Ctrl-Break reaches its group.
    Raises: OSError: another user owns it.
    """
    number = signal.SIGTERM
    if sys.platform == "win32":
        number = signal.CTRL_BREAK_EVENT
    with suppress(ProcessLookupError):  # it has ended
        os.kill(process, number)


def handle_again() -> None:
    """Install the handler of SIGTERM again: the logger of COLMAP has replaced it when pycolmap was
    imported, and would print a stack trace."""
    handler = signal.getsignal(signal.SIGTERM)
    if callable(handler) and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


@contextmanager
def ended_together(child: subprocess.Popen[Any]) -> Iterator[None]:
    """Pass these signals on to a process that handles them, too. A terminal sends Ctrl-C to it."""
    _children.append(child)
    try:
        yield
    finally:
        _children.remove(child)


def _leave_terminal() -> None:
    """Discard further output, unless it goes to a file: writing to a closed terminal fails."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for descriptor in (1, 2):
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.dup2(nowhere, descriptor)
