"""What a training asks of its process: one thread of torch, and Ctrl-C in its place."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch


@contextmanager
def single_threaded() -> Iterator[None]:
    """Torch on one thread: its sums depend on the number of threads. Those of `ops` do not."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


_held = threading.Event()  # a Ctrl-C that `interrupts_between_steps` holds back


def let_interrupt() -> None:
    """Raise the Ctrl-C that is held back: for those who wait between two steps."""
    if _held.is_set():
        raise KeyboardInterrupt


@contextmanager
def interrupts_between_steps() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back until the function that this gives is called. The second one is not held.

    Where Python's own handler of SIGINT is not in place, whoever replaced it decides.
    """

    def hold(*_: object) -> None:
        _held.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    main_thread = threading.current_thread() is threading.main_thread()
    if not main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield lambda: None
        return
    signal.signal(signal.SIGINT, hold)
    try:
        yield let_interrupt
    finally:
        _held.clear()
        signal.signal(signal.SIGINT, signal.default_int_handler)
