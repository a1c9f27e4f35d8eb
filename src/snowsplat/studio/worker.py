"""What the studio does in other processes: all that takes long, or needs torch.

    python -m snowsplat.studio make FOLDER          the job of a scene of the library
    python -m snowsplat.studio film FOLDER          its film, as film.json says
    python -m snowsplat.studio preview FOLDER       the path of this film
    python -m snowsplat.studio survey FOLDER        what its photos are, and the time needed
    python -m snowsplat.studio export FOLDER KIND   a file in another format
    python -m snowsplat.studio show FOLDER          the site of a scene, anew
    python -m snowsplat.studio rename FOLDER TITLE  its title, also in the site
    python -m snowsplat.studio whole FOLDER         the page that edits a scene with levels
    python -m snowsplat.studio edit FOLDER VERSION  what was changed in the page of this version
    python -m snowsplat.studio undo FOLDER VERSION  the scene as it was made

The first two write their progress to a file in the folder. The others print one line of JSON; of
those that change files, one at a time works on a scene, also if the studio was killed and started
again meanwhile.
"""

from __future__ import annotations

import json
import logging
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.pipeline.cameras_from_above import cameras_from_above, draw_level
from snowsplat.pipeline.describe_photos import describe_photos
from snowsplat.pipeline.film import film, film_preview
from snowsplat.pipeline.make import make
from snowsplat.pipeline.make_result import MakeResult
from snowsplat.pipeline.observer import Observer, Page
from snowsplat.pipeline.options.make import MakeOptions
from snowsplat.pipeline.options.publish import PublishOptions
from snowsplat.pipeline.publish import publish
from snowsplat.pipeline.quality import PRESETS
from snowsplat.pipeline.run.live_page import LivePage
from snowsplat.pipeline.stage_lines import described
from snowsplat.project.edit_record import shown_file
from snowsplat.project.project import Project
from snowsplat.project.studio_scene import TASKS, StudioScene, version_of
from snowsplat.sfm.colmap.options import thread_count
from snowsplat.sfm.cost import Step, measure_speed, predicted_seconds, survey
from snowsplat.sfm.ingest.search.sources import find_sources
from snowsplat.sfm.progress import Report
from snowsplat.sfm.report.dataset_report import draw_from_above
from snowsplat.sfm.report.scene_map import PlacedPhoto
from snowsplat.studio import changes
from snowsplat.studio.changes import existing_reports, finished
from snowsplat.training.core.progress import Progress
from snowsplat.util.errors import UserError, message_of
from snowsplat.util.files import write_text
from snowsplat.util.interrupts import ended_by_signals
from snowsplat.util.messages import Message, message
from snowsplat.util.run_lock import locked
from snowsplat.util.safe_json import printable
from snowsplat.util.stages import Outcome

# Seconds for an edit or export of a killed studio to end.
_LONGEST_CHANGE = 600.0
_PAUSE = 1.0  # seconds between two files of the state
_CURVE = 400  # points of the curve of the loss


class _Recorder(Observer):
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
        self.state["notes"].append(printable(str(line)))
        self.write()

    def begin(self, stage: str) -> Report:
        self.state["now"] = now = {"stage": stage, "began": time.time()}
        self.write()

        def report(done: int, total: int, what: str = "", left: float | None = None) -> None:
            now.update({"done": done, "total": total, "what": what, "left": left})
            self.write(now=False)

        return report

    def end(self, stage: str, outcome: Outcome) -> None:
        lines = [printable(str(line)) for line in described(stage, outcome.result)]
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


def run_job(scene: StudioScene, task: str) -> int:
    """Do one of the `TASKS`, or resume it, under its lock; returns the exit code."""
    recorder = _Recorder(scene, task)
    code, outcome = _outcome(scene, task, recorder)
    for name in ("now", "page", "placed"):
        recorder.state.pop(name, None)
    recorder.state |= outcome
    recorder.write()
    return code


def _outcome(scene: StudioScene, task: str, recorder: _Recorder) -> tuple[int, dict[str, Any]]:
    """The exit code of the job, and what it adds to the state."""
    try:
        with ended_by_signals():
            result = _make(scene, recorder) if task == "make" else _film(scene, recorder)
        return 0, {"outcome": "done", "result": result}
    except KeyboardInterrupt:
        return 130, {"outcome": "stopped"}
    except MemoryError:
        message = "out of memory; choose draft, or fewer photos"
        return 2, {"outcome": "failed", "error": message}
    except (UserError, OSError) as error:
        return 2, {"outcome": "failed", "error": _line(error)}
    except Exception as error:
        traceback.print_exc()
        what, log = f"{type(error).__name__}: {error}", scene.log(task)
        about = f"an unexpected fault: {what}; details are in {log}"
        return 1, {"outcome": "failed", "error": printable(about)}


def _line(error: UserError | OSError) -> str:
    text = str(message_of(error) if isinstance(error, OSError) else error)
    return printable(" ".join(text.split()))


def _make(scene: StudioScene, recorder: _Recorder) -> dict[str, Any]:
    with locked(scene.edit_lock, f"{scene.folder}: in use by", _LONGEST_CHANGE):
        # An edit that has begun ends first; none begins while this job runs. What an edit that was
        # killed has left to do is not for the scene that is made now.
        scene.begun.unlink(missing_ok=True)
    job = scene.job
    scene.map.unlink(missing_ok=True)  # the photos may be others now
    options = MakeOptions(quality=job.quality, minutes=job.minutes, title=job.title)  # type: ignore[arg-type]
    with LivePage(port=0) as page:
        made = make(
            scene.inputs(), scene.made, options, overwrite=True, observer=recorder, page=page
        )
    recorder.begin("page")
    file = shown_file(made.scene)
    shown = [version_of(file), job.title]
    site = publish(file, scene.site, PublishOptions(job.title), overwrite=True)
    recorder.leave()
    return _result(scene, made) | {"gaussians": site.gaussians, "shown": shown}


def _film(scene: StudioScene, recorder: _Recorder) -> dict[str, Any]:
    file = film(finished(scene), scene.film_plan(), scene.keys, scene.film, observer=recorder)
    return {"bytes": file.stat().st_size}


def _result(scene: StudioScene, made: MakeResult) -> dict[str, Any]:
    known = made.figures
    reports = {"training": made.training.report, "photos": made.dataset_report}
    return {
        "file": made.scene.name,
        "bytes": made.scene.stat().st_size,
        # With gains of exposure, the scene has the mean exposure of the photos.
        "psnr": known.psnr_aligned if known.exposures else known.psnr,
        "aligned": known.exposures,
        "seconds": made.seconds,
        "verdict": [] if made.verdict is None else made.verdict.lines(message("the scene")),
        "reports": existing_reports(scene, reports),
    }


def survey_photos(scene: StudioScene) -> dict[str, Any]:
    """What `make` would use of the inputs, and the seconds that it takes at each quality.

    Raises: UserError: there is nothing to use.
    """
    sources = find_sources(scene.inputs())
    photos = survey(sources)
    speed = measure_speed(thread_count(None))
    seconds = {}
    for quality, preset in PRESETS.items():
        seconds[quality] = Step(preset.training).seconds(speed)
        if sources.posed is None:
            seconds[quality] += predicted_seconds(photos, preset.photos, quality, speed)
    facts = describe_photos(sources) | {"poses": sources.posed is not None}
    return {
        "facts": facts,
        "count": photos.count,
        "seconds": {quality: round(value) for quality, value in seconds.items()},
    }


def _answer(scene: StudioScene, words: list[str]) -> dict[str, Any]:
    if words[0] == "survey":
        return survey_photos(scene)
    if words[0] == "preview":
        return {"path": film_preview(finished(scene), scene.film_plan())}
    scene.kept.mkdir(exist_ok=True, mode=0o700)
    with locked(scene.edit_lock, f"{scene.folder}: in use by", _LONGEST_CHANGE):
        if words[0] == "export":
            return changes.export(scene, words[1])
        if words[0] == "show":
            return changes.show_scene(scene)
        if words[0] == "rename":
            return changes.rename(scene, words[1])
        if words[0] == "whole":
            return changes.show_whole(scene)
        return changes.edit_scene(scene, words[1], words[0] == "undo")


def _printed(scene: StudioScene, words: list[str]) -> int:
    try:
        answer = _answer(scene, words)
    except (UserError, OSError) as error:
        answer = {"error": _line(error)}
    print("\n" + json.dumps(answer))
    return 0


def main(words: list[str]) -> int:
    logging.basicConfig(level=logging.WARNING)
    scene = StudioScene(Path(words[1]))
    if words[0] in TASKS:
        return run_job(scene, words[0])
    return _printed(scene, [words[0], *words[2:]])
