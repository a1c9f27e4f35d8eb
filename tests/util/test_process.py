"""Ctrl-C held back, and let through by those who wait."""

import os
import signal
import threading
from collections.abc import Callable

import pytest

from snowsplat.util.process import interrupts_between_steps, let_interrupt


def press() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def done_before_interrupt(*actions: Callable[[], None]) -> int:
    """How many actions end before Ctrl-C comes through."""
    done = 0
    try:
        with interrupts_between_steps():
            for action in actions:
                action()
                done += 1
    except KeyboardInterrupt:
        return done
    raise AssertionError("no Ctrl-C came through")


def test_it_is_held_until_it_is_let_through():
    let_interrupt()
    assert done_before_interrupt(let_interrupt, press, lambda: None, let_interrupt, press) == 3
    let_interrupt()  # that was all of it
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_the_second_one_is_not_held():
    assert done_before_interrupt(press, press) == 1


def test_the_trainer_lets_it_through_by_what_it_was_given():
    with interrupts_between_steps() as let:
        let()
        press()
        with pytest.raises(KeyboardInterrupt):
            let()


def test_what_came_after_the_last_step_is_forgotten_with_it():
    with interrupts_between_steps():
        press()
    let_interrupt()


def test_elsewhere_nothing_is_held():
    found = []

    def run() -> None:
        with interrupts_between_steps() as let:
            let()
            found.append(True)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [True]
