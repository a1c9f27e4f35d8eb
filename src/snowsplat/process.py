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


@contextmanager
def interrupts_between_steps() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back until the function that this gives is called. The second one is not held.

    Where Python's own handler of SIGINT is not in place, whoever replaced it decides.
    """
    pending = threading.Event()

    def hold(*_: object) -> None:
        pending.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def let_interrupt() -> None:
        if pending.is_set():
            raise KeyboardInterrupt

    main_thread = threading.current_thread() is threading.main_thread()
    if not main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield let_interrupt
        return
    signal.signal(signal.SIGINT, hold)
    try:
        yield let_interrupt
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
