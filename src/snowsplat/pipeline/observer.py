"""`Observer`: receives the progress of the functions of this package."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

from snowsplat.sfm.progress import Report, silent
from snowsplat.util.messages import Message

if TYPE_CHECKING:
    import numpy as np

    from snowsplat.pipeline.run.results import TrainResult
    from snowsplat.sfm.report.scene_map import PlacedPhoto
    from snowsplat.training.core.progress import Progress
    from snowsplat.util.messages import Message
    from snowsplat.util.stages import Outcome


class Page(Protocol):
    """A page in the browser: its address, and those for other computers if they differ."""

    @property
    def url(self) -> str: ...

    @property
    def others(self) -> list[str]: ...


class Observer:
    """The base class of observers. Its methods do nothing; a subclass overrides those it needs.

    A job such as `make` consists of stages. `begin` and `end` are called for each stage. The
    training also reports its steps.
    """

    def note(self, line: Message) -> None:
        """A line of information for the user."""

    def begin(self, stage: str) -> Report:
        """Called for every stage, also if an earlier run has finished it.

        Returns the progress callback of the stage.
        """
        return silent

    def end(self, stage: str, outcome: Outcome) -> None:
        """The stage has finished, now or in an earlier run."""

    def show_poses(self, photos: Sequence[PlacedPhoto], points: np.ndarray) -> None:
        """Photos have a pose; see `snowsplat.sfm.progress.ShowPoses`."""

    def leave(self) -> None:
        """The stage that began last is over; there is nothing to tell about it."""

    @contextmanager
    def waiting(self, stage: str) -> Iterator[Report]:
        """A context of a stage that may take a while and has no outcome; its progress callback."""
        try:
            yield self.begin(stage)
        finally:
            self.leave()

    def steps_begin(self, step: int, iterations: int) -> None:
        """A training run begins after ``step`` of ``iterations`` steps."""

    def step(self, progress: Progress) -> None:
        """A training step is finished."""

    def steps_end(self) -> None:
        """The last step is finished, or the training was interrupted."""

    @contextmanager
    def stepping(self, step: int, iterations: int) -> Iterator[None]:
        """A context of the steps of a training run; see `steps_begin` and `steps_end`."""
        self.steps_begin(step, iterations)
        try:
            yield
        finally:
            self.steps_end()

    def trained(self, result: TrainResult) -> None:
        """The training has finished; its files are written."""

    def page_opened(self, page: Page) -> None:
        """A page shows the scene in the browser at ``page.url``."""


class Observers(Observer):
    """Passes everything on to several observers."""

    def __init__(self, *observers: Observer) -> None:
        self.all = observers

    def begin(self, stage: str) -> Report:
        reports = [each.begin(stage) for each in self.all]

        def report(done: int, total: int, what: str = "", left: float | None = None) -> None:
            for each in reports:
                each(done, total, what, left)

        return report


def _passed_on(name: str) -> Callable[..., None]:
    def call(observers: Observers, *arguments: object) -> None:
        for each in observers.all:
            getattr(each, name)(*arguments)

    return call


for _name in (
    *("note", "end", "show_poses", "leave", "page_opened"),
    *("steps_begin", "step", "steps_end", "trained"),
):
    setattr(Observers, _name, _passed_on(_name))

#: An observer that does nothing.
SILENT = Observer()
