"""The progress callback of a long job."""

from __future__ import annotations

from typing import Protocol


class Report(Protocol):
    """Called repeatedly: ``done`` of ``total`` items are finished; a total of 0 is unknown.

    ``what`` names the items, e.g. "photos".
    """

    def __call__(self, done: int, total: int, what: str = "") -> None: ...


def silent(done: int, total: int, what: str = "") -> None:
    """A `Report` that does nothing."""
