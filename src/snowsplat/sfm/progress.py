"""The progress callback of a long job."""

from __future__ import annotations

from typing import Protocol


class Report(Protocol):
    """A callback that a long job calls repeatedly.

    ``done`` of ``total`` items are finished. If ``total`` is 0, the total is unknown. ``what`` is
    the name of the items, as text for users, for example "photos". ``left`` is the estimated time
    in seconds until the job is finished; None: it is not known.
    """

    def __call__(
        self, done: int, total: int, what: str = "", left: float | None = None
    ) -> None: ...


def silent(done: int, total: int, what: str = "", left: float | None = None) -> None:
    """A `Report` that does nothing."""


class Figures(Protocol):
    """A callback that receives figures about the child process that estimates the poses.

    ``cpu_seconds`` is its processor time so far. ``features`` is the mean number of features of a
    photo; 0: not known yet.
    """

    def __call__(self, cpu_seconds: float, features: float) -> None: ...


def ignored(cpu_seconds: float, features: float) -> None:
    """A `Figures` that does nothing."""
