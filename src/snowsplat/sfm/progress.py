"""The progress callback of a long job."""

from __future__ import annotations

from typing import Protocol


class Report(Protocol):
    """A callback that a long job calls repeatedly.

    ``done`` of ``total`` items are finished. If ``total`` is 0, the total is unknown. ``what`` is
    the name of the items, as text for users, for example "photos".
    """

    def __call__(self, done: int, total: int, what: str = "") -> None: ...


def silent(done: int, total: int, what: str = "") -> None:
    """A `Report` that does nothing."""
