"""Settings of the process during training: one torch thread, and deferred Ctrl-C."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch


@contextmanager
def single_threaded() -> Iterator[None]:
    """Run torch on one thread, so that its sums do not depend on the number of threads.

    The results of `ops` never depend on the number of threads.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


# Set while a Ctrl-C is deferred by `interrupts_between_steps`.
_pending = threading.Event()


def raise_deferred_interrupt(agree: Callable[[bool], bool] = bool) -> None:
    """Raise KeyboardInterrupt if a Ctrl-C is deferred; for code that waits between steps.

    Args:
        agree: combines whether a Ctrl-C is deferred in this process with the same in the others.
    """
    if agree(_pending.is_set()):
        raise KeyboardInterrupt


@contextmanager
def interrupts_between_steps() -> Iterator[Callable[..., None]]:
    """Defer Ctrl-C until the function that the context provides is called.

    A second Ctrl-C is not deferred. Nothing is changed if Python's own handler of SIGINT has been
    replaced, or outside of the main thread.
    """

    def defer(*_: object) -> None:
        _pending.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    main_thread = threading.current_thread() is threading.main_thread()
    if not main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield lambda *_: None
        return
    signal.signal(signal.SIGINT, defer)
    try:
        yield raise_deferred_interrupt
    finally:
        _pending.clear()
        signal.signal(signal.SIGINT, signal.default_int_handler)
