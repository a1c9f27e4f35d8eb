"""How a long job says how far it is."""

from __future__ import annotations

from typing import Protocol


class Report(Protocol):
    """Called now and then: ``done`` of ``total`` (0: not known) of ``what`` are finished."""

    def __call__(self, done: int, total: int, what: str = "") -> None: ...


def silent(done: int, total: int, what: str = "") -> None:
    """A `Report` that says nothing."""
