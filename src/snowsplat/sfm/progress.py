"""The progress callback of a long job, and work in threads that calls it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    import numpy as np

    from snowsplat.sfm.report.scene_map import PlacedPhoto


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


class ShowPoses(Protocol):
    """Receives the photos that have a pose so far, and some points (P, 3), every two seconds.

    Scale and orientation are arbitrary, and another attempt begins anew.
    """

    def __call__(self, photos: Sequence[PlacedPhoto], points: np.ndarray) -> None: ...


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def in_threads(
    work: Callable[[_Item], _Result],
    photos: Sequence[_Item],
    threads: int,
    report: Report,
    begin: Callable[[], None] = lambda: None,
) -> list[_Result]:
    """The results of ``work`` for each of ``photos``, in their order.

    Each thread calls ``begin`` first. After the first error or Ctrl-C, running work is finished,
    and the rest is cancelled.
    """
    results: list[_Result] = []
    pool = ThreadPoolExecutor(threads, "snowsplat-photos", begin)
    try:
        for result in pool.map(work, photos):
            results.append(result)
            report(len(results), len(photos), "photos")
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return results
