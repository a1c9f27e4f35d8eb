"""Deferred Ctrl-C."""

import os
import signal
import threading
from collections.abc import Callable

import pytest

from snowsplat.util.process import interrupts_between_steps, raise_deferred_interrupt


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
