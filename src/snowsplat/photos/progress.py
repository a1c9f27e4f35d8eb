"""How a long job says how far it is."""

from __future__ import annotations

from typing import Protocol


class Report(Protocol):
    """Called now and then with how much is ``done`` of ``total`` (0: not known) and what that is."""

    def __call__(self, done: int, total: int, what: str = "") -> None: ...


def silent(done: int, total: int, what: str = "") -> None:
    """A `Report` that says nothing."""
