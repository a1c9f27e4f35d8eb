"""`TerminalObserver`: prints the progress of a pipeline function."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from snowsplat.cli.pages import for_other_computers
from snowsplat.cli.print_message import print_message
from snowsplat.cli.stage_progress import StageProgress
from snowsplat.cli.step_progress import StepProgress, held_out_line
from snowsplat.pipeline.observer import Observer
from snowsplat.pipeline.stage_lines import described
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.duration import duration
from snowsplat.util.messages import Message, message

if TYPE_CHECKING:
    from snowsplat.pipeline.observer import Page
    from snowsplat.pipeline.run.train_result import TrainResult
    from snowsplat.sfm.progress import Report
    from snowsplat.training.core.progress import Progress
    from snowsplat.util.stages import Outcome


class TerminalObserver(Observer):
    """Prints results to stdout and, unless ``quiet``, also notes and progress.

    It is a context manager: leaving the context removes the progress bar, also after an error.
    """

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._stages = StageProgress(quiet)
        self._steps: StepProgress | None = None

    def __enter__(self) -> TerminalObserver:
        return self

    def __exit__(self, *_: object) -> None:
        self._stages.hide()
        self.steps_end()

    def note(self, line: Message) -> None:
        if self._steps is not None:
            self._steps.say(str(line))
        else:
            self._stages.say(str(line))

    def begin(self, stage: str) -> Report:
        return self._stages.begin(stage)

    def end(self, stage: str, outcome: Outcome) -> None:
        line, *details = described(stage, outcome.result)
        self._stages.end(str(line), outcome.seconds, outcome.again)
        if not outcome.again:
            for detail in details:
                self._stages.say(f"          {detail}")

    def leave(self) -> None:
        self._stages.hide()

    def steps_begin(self, step: int, iterations: int) -> None:
        self._stages.hide()
        if not self._quiet:
            self._steps = StepProgress(iterations, step)

    def step(self, progress: Progress) -> None:
        if self._steps is not None:
            self._steps(progress)

    def steps_end(self) -> None:
        if self._steps is not None:
            self._steps.close()
            self._steps = None

    def trained(self, result: TrainResult) -> None:
        steps = result.step - result.first_step
        count = message("{steps} more steps", steps=steps)
        if not result.first_step:
            count = message("{steps} steps", steps=steps)
        print_message(
            "{scene}: {gaussians:,} Gaussians, {st_size}, {count} in {seconds}, {memory}",
            scene=result.scene,
            gaussians=result.gaussians,
            st_size=format_bytes(result.scene.stat().st_size),
            count=count,
            seconds=duration(result.seconds),
            memory=result.memory,
        )
        for line in result.reductions:
            print_message("for lack of memory: {line}", line=line)
        print_message("{report}: the report of the training", report=result.report)
        if result.evaluation is not None:
            print(held_out_line(*result.evaluation))
        for part in result.parts.values():
            for each in part.lines:
                print(each)
        if result.time is not None:
            spent, given = map(duration, result.time)
            print_message("{spent} in total, of {given}", spent=spent, given=given)
        sys.stdout.flush()

    def page_opened(self, page: Page) -> None:
        print_message("watch it in a browser: {url}", url=page.url)
        for line in for_other_computers(page.url, page.others):
            print_message(line)


class WatchObserver(TerminalObserver):
    """The observer of `snowsplat watch`, which Ctrl-C ends."""

    def page_opened(self, page: Page) -> None:
        super().page_opened(page)
        print_message("Ctrl-C ends it")
