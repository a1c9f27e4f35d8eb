"""What the studio does in other processes: all that takes long, or needs torch.

    python -m snowsplat.studio VERB FOLDER [SETTINGS]

FOLDER is that of a scene of the library, and SETTINGS is a JSON object. The verbs of `TASKS` make a
scene or a film; they write their progress to a file in the folder. The others (`VERBS`) print one
line of JSON; of those that change files, one at a time works on a scene, also if the studio was
killed and started again meanwhile.
"""

import json
import logging
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.pipeline.convert import convert
from snowsplat.pipeline.demo import take_demo_photos
from snowsplat.pipeline.describe_photos import describe_photos
from snowsplat.pipeline.edit import film, film_preview
from snowsplat.pipeline.make import make
from snowsplat.pipeline.make_plan import expected_seconds
from snowsplat.pipeline.options.make import PRESETS, MakeOptions
from snowsplat.pipeline.run.live_page import LivePage
from snowsplat.pipeline.run.results import MakeResult
from snowsplat.project.edit_record import shown_file
from snowsplat.project.project import scene_at
from snowsplat.project.studio_scene import TASKS, StudioScene, version_of
from snowsplat.sfm.colmap.options import thread_count
from snowsplat.sfm.cost import measure_speed, survey
from snowsplat.sfm.ingest.photos.photo_files import Unusable, read_header
from snowsplat.sfm.ingest.search.sources import find_sources
from snowsplat.sfm.report.capture_verdict import few_photos
from snowsplat.sfm.report.photo_problems import PROBLEMS, problems_of, small_grey
from snowsplat.studio import changes
from snowsplat.studio.given_photos import given_photos
from snowsplat.studio.library import safe_name
from snowsplat.studio.recorder import Recorder
from snowsplat.studio.texts import in_languages
from snowsplat.util.errors import UserError, message_of
from snowsplat.util.files import shown
from snowsplat.util.flags import settings_from
from snowsplat.util.interrupts import ended_by_signals
from snowsplat.util.messages import Message, message
from snowsplat.util.own_files import import_own_files
from snowsplat.util.run_lock import locked

# Seconds for an edit or export of a killed studio to end.
_LONGEST_CHANGE = 600.0


def run_job(scene: StudioScene, task: str) -> int:
    """Do one of the `TASKS`, or resume it, under its lock; returns the exit code."""
    recorder = Recorder(scene, task)
    code, outcome = _outcome(scene, task, recorder)
    for name in ("now", "page", "placed"):
        recorder.state.pop(name, None)
    recorder.state |= outcome
    recorder.write()
    return code


def _outcome(scene: StudioScene, task: str, recorder: Recorder) -> tuple[int, dict[str, Any]]:
    """The exit code of the job, and what it adds to the state."""
    try:
        with ended_by_signals():
            return 0, {"outcome": "done", "result": _JOBS[task](scene, recorder)}
    except KeyboardInterrupt:
        return 130, {"outcome": "stopped"}
    except MemoryError:
        about = message("out of memory; choose draft, or fewer photos")
        return 2, {"outcome": "failed", "error": in_languages(about)}
    except (UserError, OSError) as error:
        return 2, {"outcome": "failed", "error": in_languages(message_of(error))}
    except Exception as error:
        traceback.print_exc()
        what = f"{type(error).__name__}: {error}"
        about = message(
            "an unexpected fault: {what}; details are in {log}", what=what, log=scene.log(task)
        )
        return 1, {"outcome": "failed", "error": in_languages(about)}


def _make(scene: StudioScene, recorder: Recorder) -> dict[str, Any]:
    with locked(scene.edit_lock, str(scene.folder), _LONGEST_CHANGE):
        # An edit that has begun ends first; none begins while this job runs. What an edit that was
        # killed has left to do is not for the scene that is made now.
        scene.begun.unlink(missing_ok=True)
    job = scene.job
    scene.map.unlink(missing_ok=True)  # the photos may be others now
    if job.example:
        take_demo_photos(scene.photos, recorder)
    if (given := _given_scene(scene)) is not None:
        recorder.begin("page")
        file = scene.made / f"{safe_name(job.title)}.ply"
        file.parent.mkdir(exist_ok=True)
        convert(given, file, overwrite=True)
        result = {"file": file.name, "bytes": file.stat().st_size, "reports": {}}
        result |= {"psnr": None, "aligned": False, "seconds": None}
    else:
        options = settings_from(MakeOptions, job.settings())
        with LivePage(port=0) as page:
            made = make(
                scene.inputs(), scene.made, options, overwrite=True, observer=recorder, page=page
            )
        recorder.begin("page")
        file, result = shown_file(made.scene), _result(scene, made)
    shown = [version_of(file), job.title]
    site = changes.publish_site(scene, file, job.title)
    recorder.leave()
    return result | {"gaussians": site.gaussians, "shown": shown}


def _given_scene(scene: StudioScene) -> Path | None:
    """A finished scene, if that was given in place of photos."""
    inputs = scene.inputs()
    return scene_at(inputs[0]) if len(inputs) == 1 else None


def _film(scene: StudioScene, recorder: Recorder) -> dict[str, Any]:
    file = film(
        changes.finished(scene), scene.film_plan(), scene.keys, scene.film, observer=recorder
    )
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
        "reports": changes.existing_reports(scene, reports),
    }


def survey_photos(scene: StudioScene, _: str = "") -> dict[str, Any]:
    """What `make` would use of the inputs, the seconds that it takes at each quality, and whether
    the photos are few; or the name of the finished scene that was given.

    Raises: UserError: there is nothing to use.
    """
    if (given := _given_scene(scene)) is not None:
        return {"scene": given.name}
    sources = find_sources(scene.inputs())
    photos = survey(sources)
    speed = measure_speed(thread_count(None))
    poses = sources.posed is None
    seconds = {each: expected_seconds(each, photos, speed, poses) for each in PRESETS}
    facts = describe_photos(sources) | {"poses": sources.posed is not None}
    few = few_photos(facts.get("photos", 0) + photos.frames)
    return {
        "few": few
        and {
            "grade": few.grade,
            "text": in_languages(few.text),
            "advice": in_languages(few.advice),
        },
        "facts": {name: _in_languages(value) for name, value in facts.items()},
        "count": photos.count,
        "seconds": {quality: round(value) for quality, value in seconds.items()},
    }


def mark_photos(scene: StudioScene, _: str = "") -> dict[str, Any]:
    """What is wrong with single photos, by the name in `given_photos`: damaged, double, blurred …

    Raises: UserError: there is nothing to use.
    """
    given = [photo for photo in given_photos(scene) if not photo.out]
    reasons = {each.photo: each.reason for each in find_sources(scene.inputs()).left_out}
    marks: dict[str, Message] = {}
    greys: dict[str, np.ndarray] = {}
    for photo in given:
        try:
            read_header(photo.path)
            greys[photo.name] = small_grey(photo.path)
        except (Unusable, OSError) as error:
            marks[photo.name] = message_of(error) if isinstance(error, OSError) else error.message
        if (reason := reasons.get(shown(photo.path))) is not None:
            marks[photo.name] = reason
    for name, problem in zip(greys, problems_of(greys.values()), strict=True):
        if problem is not None:
            marks.setdefault(name, PROBLEMS[problem].what)
    return {"marks": {name: in_languages(why) for name, why in marks.items()}}


def _in_languages(value: Any) -> Any:
    """A fact with its texts in each language: see `in_languages`."""
    if isinstance(value, dict):
        return {name: _in_languages(each) for name, each in value.items()}
    return in_languages(value) if isinstance(value, Message) else value


def _preview(scene: StudioScene, _: str) -> dict[str, Any]:
    return {"path": film_preview(changes.finished(scene), scene.film_plan())}


@dataclass(frozen=True)
class Verb:
    """A short task.

    Attributes:
        run: does it for a scene with its setting; returns the answer.
        setting: the name of its only setting, a text; "": there is none.
        changes: whether it changes files.
    """

    run: Callable[[StudioScene, str], dict[str, Any]]
    setting: str = ""
    changes: bool = True


VERBS = {
    "survey": Verb(survey_photos, changes=False),
    "marks": Verb(mark_photos, changes=False),
    "preview": Verb(_preview, changes=False),
    "export": Verb(changes.export, "kind"),
    "show": Verb(changes.show_scene),
    "rename": Verb(changes.rename, "title"),
    "whole": Verb(changes.show_whole),
    "edit": Verb(changes.edit_scene, "version"),
    "undo": Verb(changes.undo_edit, "version"),
}
_JOBS = {"make": _make, "film": _film}


def _answer(verb: Verb, scene: StudioScene, given: dict[str, Any]) -> dict[str, Any]:
    setting = given[verb.setting] if verb.setting else ""
    if not verb.changes:
        return verb.run(scene, setting)
    scene.kept.mkdir(exist_ok=True, mode=0o700)
    with locked(scene.edit_lock, str(scene.folder), _LONGEST_CHANGE):
        return verb.run(scene, setting)


def main(words: list[str]) -> int:
    logging.basicConfig(level=logging.WARNING)
    import_own_files()
    name, folder, *settings = words
    scene = StudioScene(Path(folder))
    if name in TASKS:
        return run_job(scene, name)
    try:
        answer = _answer(VERBS[name], scene, json.loads(settings[0]) if settings else {})
    except (UserError, OSError) as error:
        answer = {"error": message_of(error).as_json()}
    print("\n" + json.dumps(answer))
    return 0
