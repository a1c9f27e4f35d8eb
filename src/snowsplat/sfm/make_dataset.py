"""Makes the folder of a dataset (`DatasetFolder`) from photos: photos, poses, images, report.

An interrupted run resumes where it stopped; see `snowsplat.util.stages`.
"""

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from snowsplat.data.frame.placement import PLACEMENT
from snowsplat.project.dataset_folder import IMAGE_FOLDERS, DatasetFolder
from snowsplat.sfm.colmap import describe_model, estimate_poses
from snowsplat.sfm.colmap.options import PANORAMA_MODEL, thread_count
from snowsplat.sfm.cost import survey
from snowsplat.sfm.ingest.inputs import Gathered, gather
from snowsplat.sfm.ingest.photo import Photo
from snowsplat.sfm.ingest.search.sources import Sources, find_sources
from snowsplat.sfm.options import DatasetOptions, GatherOptions
from snowsplat.sfm.orient import orientation
from snowsplat.sfm.orient.marker import MarkerScale, scale_of_markers
from snowsplat.sfm.progress import Report
from snowsplat.sfm.report.capture_verdict import capture_verdict
from snowsplat.sfm.report.coverage import measure_coverage
from snowsplat.sfm.report.dataset_report import write_report
from snowsplat.sfm.report.photo_problems import problems
from snowsplat.sfm.report.scene_map import PlacedPhoto
from snowsplat.sfm.time_left import Later, SfmTimeLeft
from snowsplat.sfm.undistort import undistort
from snowsplat.util.errors import UserError
from snowsplat.util.files import STAGE, new_entries, remove_temporaries
from snowsplat.util.messages import Message, message
from snowsplat.util.run_lock import LOCK, one_run
from snowsplat.util.safe_json import from_json, inside
from snowsplat.util.stages import Outcome, Stages

STAGES = ("photos", "poses", "images", "report")
_RECORD, _REPORT = DatasetFolder.record.name, DatasetFolder.report.name
_PHOTOS = DatasetFolder.photos.name
_OUTPUT_NAMES = (DatasetFolder.distorted.name, *IMAGE_FOLDERS, _RECORD, _REPORT)


class Watcher(Protocol):
    """Receives the progress of the stages."""

    def begin(self, stage: str) -> Report:
        """Called for every stage, also if an earlier run has finished it; returns its progress
        callback."""

    def end(self, stage: str, outcome: Outcome) -> None:
        """Called when the stage is finished, now or in an earlier run."""

    def note(self, line: Message) -> None:
        """Called with a line of information for the user."""

    def show_poses(self, photos: Sequence[PlacedPhoto], points: np.ndarray) -> None:
        """Called every two seconds while photos get their poses; see `progress.ShowPoses`."""


def make_dataset(
    inputs: Sequence[Path] | Sources,
    folder: Path,
    options: DatasetOptions,
    watcher: Watcher,
    overwrite: bool = False,
    later: Later | None = None,
) -> dict[str, Outcome]:
    """Make a dataset in ``folder`` from photos, videos, and folders of photos or videos.

    Stages that an earlier run with the same inputs and settings has finished are skipped. If
    ``folder / "input"`` itself is the input, it is not changed.

    Args:
        inputs: what to make the dataset from, or what `find_sources` has found there.
        overwrite: replace a dataset in ``folder`` that was made from other inputs.
        later: the rest of the job, which the time left includes; None: the dataset is all of it.

    Returns:
        The outcome of each stage. Its result is a JSON value: a `Gathered` for "photos", an
        `SfmResult` for "poses", an `Undistorted` for "images"; for "report", the file name and a
        `Verdict`.

    Raises:
        UserError: the photos cannot be used, ``folder`` contains other files, another run writes to
            it, no poses were found, or pycolmap is missing. In these cases, the files that this run
            created are removed. This error is also raised if the disk is full; in this case, the
            files remain.
        OSError: a file cannot be read or written.
    """
    sources = inputs if isinstance(inputs, Sources) else find_sources(inputs)
    in_place = sources.contain(DatasetFolder(folder).photos)
    with one_run(folder):
        _check_free(folder, in_place, sources, options, overwrite)
        with _remove_on_failure(folder):
            stages = Stages(folder / _RECORD, STAGES)
            paths = [str(path.absolute()) for path in sources.inputs]
            stages.about = {"inputs": paths, "in_place": in_place}
            stages.save()  # from here on the folder is recognised as a dataset
            return _run(stages, sources, folder, options, watcher, later)


def _run(
    stages: Stages,
    sources: Sources,
    folder: Path,
    options: DatasetOptions,
    watcher: Watcher,
    later: Later | None,
) -> dict[str, Outcome]:
    size, effort, threads = options.gather.size, options.sfm.effort, options.sfm.threads
    surveyed = survey(sources, options.gather)
    left = SfmTimeLeft(surveyed, size, effort, thread_count(threads), later or Later())
    outcomes: dict[str, Outcome] = {}

    def stage(name: str, settings: dict[str, Any], outputs: Sequence[str], work: Any) -> None:
        report = left.report(name, watcher.begin(name))
        outcomes[name] = stages.run(
            name,
            settings,
            [folder / output for output in outputs],
            lambda: work(report),
            lambda reason: watcher.note(
                message("{name}: repeated ({reason})", name=name, reason=reason)
            ),
        )
        watcher.end(name, outcomes[name])
        if outcomes[name].again:
            left.finished_before(name)

    chosen_photos = options.gather
    if options.sfm.camera_model == PANORAMA_MODEL:
        chosen_photos = replace(chosen_photos, panoramas=True)
    if options.skip_matching:
        chosen_photos = replace(chosen_photos, as_stored=True)

    stage(
        "photos",
        {"input": _fingerprint(sources.paths), **asdict(chosen_photos)},
        [_PHOTOS, DatasetFolder.distorted_masks.name],
        partial(_gather, sources, folder, chosen_photos, stages.about["in_place"]),
    )
    photos = _photos(folder, outcomes["photos"].result)
    left.expect_photos(len(photos))
    if options.skip_matching:
        left.finished_before("poses")

    def find_poses(report: Report) -> dict[str, Any]:
        if options.skip_matching:
            return asdict(describe_model(folder, photos))
        return asdict(estimate_poses(folder, photos, options.sfm, report, watcher.show_poses))

    settings = {k: v for k, v in asdict(options.sfm).items() if k not in ("threads", "seconds")}
    stage(
        "poses",
        settings | {"skip_matching": options.skip_matching},
        ["distorted/sparse"],
        find_poses,
    )

    of_images = {"resize": options.resize, "marker": options.marker}
    stage("images", of_images, IMAGE_FOLDERS, partial(_undistort, folder, photos, options))

    def write(report: Report) -> dict[str, Any]:
        sfm, coverage = outcomes["poses"].result, measure_coverage(DatasetFolder(folder).model)
        bad = problems(DatasetFolder(folder).photos, coverage.names)
        verdict = capture_verdict(coverage, sfm, bad, options.sfm.effort)
        values = asdict(options)
        facts = {
            "inputs": stages.about["inputs"],
            "settings": values.pop("gather") | values.pop("sfm") | values,
            "gathered": outcomes["photos"].result,
            "sfm": sfm,
            "undistorted": outcomes["images"].result,
            "seconds": {name: outcome.seconds for name, outcome in outcomes.items()},
            "problems": bad,
            "verdict": verdict.as_json(),
            "alone": later is None,
        }
        return {"file": write_report(folder, facts).name, "verdict": facts["verdict"]}

    stage("report", {}, [_REPORT], write)
    return outcomes


# The stages


def _gather(
    sources: Sources, folder: Path, options: GatherOptions, in_place: bool, report: Report
) -> dict[str, Any]:
    """Gather the photos into a temporary folder, then replace `input/` and the masks by them. If
    the photos are in `input/` already (``in_place``), only the masks are written."""
    if in_place:
        shutil.rmtree(DatasetFolder(folder).distorted_masks, ignore_errors=True)
        return asdict(gather(sources, folder, options, report))
    with new_entries(folder, [DatasetFolder.distorted_masks.name, _PHOTOS]) as new:
        return asdict(gather(sources, new, options, report))


def _undistort(
    folder: Path, photos: list[Photo], options: DatasetOptions, report: Report
) -> dict[str, Any]:
    import pycolmap

    model = pycolmap.Reconstruction(DatasetFolder(folder).distorted_model)
    marker: tuple[MarkerScale | None, list[Message]] = (None, [])
    if options.marker is not None:
        marker = scale_of_markers(model, photos, DatasetFolder(folder).photos, options.marker)
    oriented = orientation(model, photos, marker)
    scene_from_sfm, threads = oriented.scene_from_sfm, options.sfm.threads
    made = undistort(folder, photos, scene_from_sfm, options.resize, report, threads=threads)
    return asdict(made) | {
        "scene_from_sfm": scene_from_sfm.to_json(),
        PLACEMENT: asdict(oriented.placement),
    }


# Checks of the folder


def _check_free(
    folder: Path, in_place: bool, sources: Sources, options: DatasetOptions, overwrite: bool
) -> None:
    """Raises UserError if the dataset must not be written to ``folder``."""
    remove_temporaries(folder, (_RECORD, _REPORT))
    if (folder / _RECORD).is_file():
        stages = Stages(folder / _RECORD, STAGES)
        if not in_place and stages.about.get("in_place") is True:
            raise UserError(
                "{folder}: contains the original photos of this dataset, not copies; use another "
                "folder",
                folder=folder / _PHOTOS,
            )
        before = stages.about.get("inputs")
        same = before == [str(path.absolute()) for path in sources.inputs]
        # The photos may have been moved.
        same |= stages.settings("photos").get("input") == _fingerprint(sources.paths)
        if not same and not overwrite:
            what = before if isinstance(before, list) else message("other inputs")
            raise UserError(
                "{folder}: contains a dataset made from {what}; use another folder, or set "
                "`overwrite`",
                folder=folder,
                what=what,
            )
        return
    allowed = {LOCK, STAGE}  # the latter: left by a run that was killed in its first stage
    if in_place:
        kept = DatasetFolder(folder)
        allowed |= {kept.photos.name}
        allowed |= {kept.distorted.name} if options.skip_matching else set()
    others = sorted(entry.name for entry in folder.iterdir() if entry.name not in allowed)
    if others:
        raise UserError(
            "{folder}: contains other files ({others}{what}); use a new or an empty folder",
            folder=folder,
            others=", ".join(others[:3]),
            what=", …" if len(others) > 3 else "",
        )


@contextmanager
def _remove_on_failure(folder: Path) -> Iterator[None]:
    """After an error, remove the files that this run has created, if they are of no use.

    After a `UserError` they are removed, because the inputs are unusable. After Ctrl-C or if the
    disk is full, they remain if the stage "photos" is finished, so that the same command resumes.
    If the folder contained a dataset before, nothing is removed.
    """
    before = {entry.name for entry in folder.iterdir()}
    try:
        yield
    except BaseException as error:
        record = folder / _RECORD
        resumable = record.is_file() and Stages(record, STAGES).is_finished("photos")
        if _RECORD not in before and (isinstance(error, UserError) or not resumable):
            for path in (folder / name for name in {_PHOTOS, ".new", *_OUTPUT_NAMES} - before):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise UserError(
                "{folder}: the disk is full; free some space, then run the same command again",
                folder=folder,
            ) from None
        raise


# JSON


def _fingerprint(files: Sequence[Path]) -> str:
    """A hash of file names, sizes and times; it changes if a photo is added, removed or edited.

    The names are relative to the folder of all files, which may be moved.
    """
    paths = [file.absolute() for file in files]
    try:
        base = Path(os.path.commonpath([path.parent for path in paths]))
    except ValueError:  # no files, or several drives of Windows
        base = Path()
    names = [os.path.relpath(path, base) if base.name else str(path) for path in paths]
    status = [path.stat() for path in paths]
    entries = [[n, s.st_size, s.st_mtime_ns] for n, s in zip(names, status, strict=True)]
    return hashlib.sha256(json.dumps(entries).encode()).hexdigest()


def _photos(folder: Path, gathered: dict[str, Any]) -> list[Photo]:
    """The photos that the stage "photos" found. Raises UserError if its record is damaged."""
    try:
        photos = from_json(Gathered, gathered).photos
        if not all(inside(DatasetFolder(folder).photos, photo.name) for photo in photos):
            raise ValueError("a photo outside of input/")
    except ValueError:
        raise UserError(
            "{record}: damaged; delete it to start again", record=folder / _RECORD
        ) from None
    return photos
