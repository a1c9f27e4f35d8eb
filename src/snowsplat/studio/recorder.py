"""`Recorder`: writes the progress of a task to the state of its scene."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from snowsplat.pipeline.cameras_from_above import cameras_from_above, draw_level
from snowsplat.pipeline.observer import Observer, Page
from snowsplat.pipeline.stage_lines import described
from snowsplat.project.project import Project
from snowsplat.project.studio_scene import StudioScene
from snowsplat.sfm.progress import Report
from snowsplat.sfm.report.dataset_report import draw_from_above
from snowsplat.sfm.report.scene_map import PlacedPhoto
from snowsplat.studio.texts import in_languages
from snowsplat.training.core.progress import Progress
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_text
from snowsplat.util.messages import Message, message
from snowsplat.util.stages import Outcome

_PAUSE = 1.0  # seconds between two files of the state
_CURVE = 400  # points of the curve of the loss


class Recorder(Observer):
    """Writes the progress of a task to the state of its scene."""

    def __init__(self, scene: StudioScene, task: str = "make") -> None:
        self._scene, self._task = scene, task
        self._written = 0.0
        self._every = 1  # steps between two points of the curve
        self._drawn = False  # the map
        self.state: dict[str, Any] = {
            "started": time.time(),
            "stages": [],
            "notes": [],
            "curve": [],
        }
        self.write()

    def write(self, now: bool = True) -> None:
        """Write the state; unless ``now``, only if the last time is a moment ago."""
        if now or time.monotonic() - self._written > _PAUSE:
            with suppress(OSError):  # a full disk is for the job to tell
                self._scene.write_state(self.state, self._task)
            self._written = time.monotonic()

    def note(self, line: Message) -> None:
        self.state["notes"].append(in_languages(line))
        self.write()

    def begin(self, stage: str) -> Report:
        self.state["now"] = now = {"stage": stage, "began": time.time()}
        self.write()

        def report(done: int, total: int, what: str = "", left: float | None = None) -> None:
            now.update({"done": done, "total": total, "what": in_languages(what), "left": left})
            self.write(now=False)

        return report

    def end(self, stage: str, outcome: Outcome) -> None:
        lines = [in_languages(line) for line in described(stage, outcome.result)]
        self.state["stages"].append(
            {"stage": stage, "lines": lines, "seconds": outcome.seconds, "again": outcome.again}
        )
        if stage == "images":
            self._draw_map(lambda made: draw_from_above(made.dataset.path))
        if stage == "poses":
            self.state.pop("placed", None)
        self.leave()

    def show_poses(self, photos: Sequence[PlacedPhoto], points: np.ndarray) -> None:
        self.state["placed"] = [photo.name for photo in photos]
        self._draw_map(lambda made: draw_level(photos, points))
        self.write()

    def leave(self) -> None:
        self.state.pop("now", None)
        self.write()

    def step(self, progress: Progress) -> None:
        if not self._drawn:  # the poses were given
            self._draw_map(lambda made: cameras_from_above(made.training_folder()))
        self.state["steps"] = {
            "step": progress.step,
            "iterations": progress.iterations,
            "gaussians": progress.gaussians,
            "left": progress.seconds_left,
        }
        if progress.metrics is not None:
            self.state["steps"]["psnr"] = progress.metrics.psnr
        curve = self.state["curve"]
        if progress.step % self._every == 0:
            curve.append([progress.step, progress.loss])
            if len(curve) > _CURVE:
                del curve[::2]
                self._every *= 2
        self.write(now=False)

    def page_opened(self, page: Page) -> None:
        self.state["page"] = page.url
        self.write()

    def steps_end(self) -> None:
        self.state.pop("page", None)
        self.write()

    def _draw_map(self, draw: Callable[[Project], str]) -> None:
        self._drawn = True
        try:
            write_text(self._scene.map, draw(Project.open(self._scene.made)))
        except (UserError, OSError) as error:  # the job goes on without it
            self.note(message("there is no map of the cameras: {error}", error=error))
