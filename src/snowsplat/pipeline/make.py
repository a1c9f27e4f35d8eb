"""`make`: make a scene from photos or a video: camera poses, training, test views, all photos.

If the input is a dataset, its camera poses are used, unless they are impossible.
"""

import itertools
import math
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from snowsplat import ops
from snowsplat.data import Dataset, read_dataset
from snowsplat.data.photos.image_loader import after_each_photo
from snowsplat.pipeline.all_photos import SHARE, train_on_all
from snowsplat.pipeline.make_plan import (
    POSES_SHARE,
    MakePlan,
    choose_plan,
    described,
    expected,
    expected_seconds,
    given_poses,
    training_seconds,
)
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.make import PRESETS, MakeOptions, Preset
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output.scene_files import write_gaussians
from snowsplat.pipeline.output.scene_source import load_trained
from snowsplat.pipeline.render import render_images
from snowsplat.pipeline.run.dataset_check import hash_of_dataset, hash_of_files
from snowsplat.pipeline.run.live_page import LivePage
from snowsplat.pipeline.run.results import Figures, LastPart, MakeResult
from snowsplat.pipeline.train import resume, train
from snowsplat.project.dataset_folder import DatasetFolder
from snowsplat.project.project import MAKE_RECORD, Project
from snowsplat.project.training_folder import DATASET, SCENE, DatasetSettings, TrainingFolder
from snowsplat.sfm.cost import measure_speed, survey
from snowsplat.sfm.ingest.search.sources import Sources, find_sources
from snowsplat.sfm.make_dataset import make_dataset
from snowsplat.sfm.options import DatasetOptions, GatherOptions, SfmOptions
from snowsplat.sfm.time_left import Later
from snowsplat.training.core import checkpoint
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.duration import duration
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.files import atomic_path, check_output, remove_temporaries
from snowsplat.util.messages import message
from snowsplat.util.own_files import own_files
from snowsplat.util.run_lock import LOCK, one_run
from snowsplat.util.safe_json import from_json
from snowsplat.util.stages import Stages

STAGES = ("scene", "pictures", "all")  # `make_dataset` records its own stages
# The fields of a preset that affect the training.
_TRAINING_FIELDS = ("side", "iterations", "max_gaussians", "densify_interval")
# Photos that the scene does not explain after this fraction of the steps are left out of the
# training: see docs/cameras.md.
_LEAVE_OUT_AFTER = 0.2
# Time between checkpoints in seconds. If the process is killed, at most this much work is lost.
_CHECKPOINT_SECONDS = 15.0
# Minimum time of a training run: in seconds, and as a fraction of the requested time. The larger
# one applies.
_MIN_SECONDS = 15.0
_MIN_SHARE = 0.15
# Approximate time to render one held-out view, in seconds.
_RENDER_SECONDS = 0.3


def scene_name(inputs: Sequence[Path]) -> str:
    """The name of a scene: the name of the first input, without its suffix.

    Raises: UserError: no inputs.
    """
    if not inputs:
        raise UserError("make needs photos; add a folder of photos, or a video")
    first = inputs[0].absolute()
    return (first.stem if first.is_file() else first.resolve().name) or "scene"


def make(
    inputs: Path | str | Sequence[Path | str],
    output: Path | str | None = None,
    options: MakeOptions | None = None,
    *,
    overwrite: bool = False,
    observer: Observer = SILENT,
    page: LivePage | None = None,
) -> MakeResult:
    """Make a scene from folders of photos, photos and videos.

    Finished stages are recorded in ``output``, so that the same call resumes after an interruption.
    A stage is repeated if its photos or settings have changed.

    Args:
        inputs: one or more photos, folders of photos, or videos; or the folder of a dataset, whose
            poses are used if `given_poses` finds them plausible.
        output: the output folder; default: NAME_scene in the current folder, where NAME is the name
            of the first input without its suffix. It contains dataset/ (unless the input is
            a dataset), scene/ (the output folder of the training) and NAME.ply (the scene).
        overwrite: replace an existing scene in ``output`` that was made from other photos.
        page: shows the training in the browser.

    Returns:
        The files of the scene and its quality on the held-out photos.

    Raises:
        UserError: photos or settings are unusable; the camera poses cannot be estimated;
            ``output`` contains other files, or another run writes to it; see also
            `snowsplat.pipeline.train.train`.
        TrainingStopped, KeyboardInterrupt: Ctrl-C. Finished stages and checkpoints are kept.
    """
    started = time.monotonic()
    options = options or MakeOptions()
    paths = [Path(each) for each in ([inputs] if isinstance(inputs, Path | str) else inputs)]
    name = scene_name(paths)
    out = Path(output) if output is not None else Path(f"{name}_scene")
    if options.compute.device is not None:  # report an unusable device before the long stages
        options.compute.apply()
    with one_run(out):
        remove_temporaries(out, (MAKE_RECORD,))
        check_output(out, lambda entry: entry.name == LOCK or (out / MAKE_RECORD).is_file())
        stages = Stages(out / MAKE_RECORD, STAGES)
        with _removed_if_alone(out):
            sources = find_sources(paths)
            _check_inputs(out, sources, stages, overwrite)
            if sources.posed is not None:
                sources = replace(sources, notes=[])  # they offer the poses
            given = _given_dataset(sources, options, observer)
            job = _Job(
                out, name, sources, given, stages, options, overwrite, observer, page, started
            )
            return job.run()


@contextmanager
def _removed_if_alone(out: Path) -> Iterator[None]:
    """If the job wrote only its record, remove it."""
    try:
        yield
    finally:
        if out.is_dir() and {entry.name for entry in out.iterdir()} <= {MAKE_RECORD, LOCK}:
            (out / MAKE_RECORD).unlink(missing_ok=True)


def _check_inputs(out: Path, sources: Sources, stages: Stages, overwrite: bool) -> None:
    """Record the inputs. Raises UserError if the folder has a scene of other photos that must not
    be replaced."""
    inputs = [str(path.absolute()) for path in sources.inputs]
    before = stages.about.get("inputs", inputs)
    # `make_dataset` compares the photos themselves, whose folder may have been renamed.
    compared = sources.posed is None and (out / DATASET).is_dir()
    if before != inputs and not (compared or overwrite):
        what = before if isinstance(before, list) else message("other inputs")
        raise UserError(
            "{out}: contains a scene made from {what}; use another folder, or set `overwrite`",
            out=out,
            what=what,
        )
    stages.about["inputs"] = inputs


def _given_dataset(sources: Sources, options: MakeOptions, observer: Observer) -> Dataset | None:
    """The dataset that is the input, if its poses are used."""
    if sources.posed is None:
        return None
    settings = DatasetSettings(str(sources.posed), **_split(options))
    given = given_poses(sources, settings, observer)
    if given is not None and options.marker is not None:
        raise SettingError(
            "marker",
            "is for poses that are estimated, and {posed} has its own; make it of the photos "
            "alone, or scale the scene afterwards: snowsplat convert --scale-to",
            posed=sources.posed,
        )
    return given


def _split(options: MakeOptions) -> dict[str, Any]:
    """Every N-th photo is held out, from the middle of the first N on: the first photo of a walk is
    at its end, and shows places that no other photo shows, so it says little."""
    return {"hold_out": options.hold_out, "first_held_out": (options.hold_out or 0) // 2}


@dataclass
class _Job:
    """One call of `make`: runs the stages in their order, except for those that are finished."""

    out: Path
    name: str  # of the scene file, without suffix
    sources: Sources
    given: Dataset | None  # the dataset that is the input; None: it is made from the photos
    stages: Stages
    options: MakeOptions
    overwrite: bool
    observer: Observer
    page: LivePage | None
    started: float  # by `time.monotonic`

    @property
    def dataset(self) -> DatasetFolder:
        posed = self.sources.posed if self.given is not None else None
        return DatasetFolder(posed or self.out / DATASET)

    @property
    def folder(self) -> TrainingFolder:
        return TrainingFolder(self.out / SCENE)

    @property
    def file(self) -> Path:
        """The scene file. An old file is replaced when the new scene is finished."""
        return self.out / f"{self.name}.ply"

    def run(self) -> MakeResult:
        plan = self._plan()
        title = self.options.title or self.stages.about.get("title") or self.name
        self.stages.about["title"] = title
        self.stages.save()  # from now on, the folder is recognised as an output of `make`
        if self.given is None:
            self._make_dataset(plan)
        # No `sfm` changes the photos during the training.
        with one_run(self.dataset.path) if self.given is None else nullcontext():
            figures, last_part = self._make_scene(plan)
        project = Project.open(self.out)
        return MakeResult(project, self.dataset, figures, last_part, self._elapsed())

    def _elapsed(self) -> float:
        return time.monotonic() - self.started

    def _stage(
        self,
        name: str,
        settings: dict[str, Any],
        outputs: list[Path],
        work: Callable[[], dict[str, Any]],
        seconds: float = 0.0,
    ) -> dict[str, Any]:
        """The result of a stage, which is executed unless it is finished.

        ``seconds``: the predicted time until the end of the job; 0: not known.
        """

        def on_change(reason: str) -> None:
            self.observer.inform("{name}: repeated ({reason})", name=name, reason=reason)

        def photo_is_prepared() -> None:
            left = max(1.0, seconds - (time.monotonic() - began)) if seconds else None
            report(next(count), 0, "prepared photos", left)

        report, count, began = self.observer.begin(name), itertools.count(1), time.monotonic()
        with after_each_photo(photo_is_prepared):
            outcome = self.stages.run(name, settings, outputs, work, on_change)
        self.observer.end(name, outcome)
        return outcome.result

    def _plan(self) -> MakePlan:
        """The plan for the requested quality or time.

        The poses depend on the plan. Therefore it is recorded, and later runs use the recorded
        plan.
        """
        quality, minutes = self.options.quality, self.options.minutes
        if minutes is None or self.given is not None:
            plan = MakePlan(quality or "normal", PRESETS[quality or "normal"].photos)
            if minutes is None and "title" not in self.stages.about and self._on_cpu():
                photos = survey(self.sources)
                speed = measure_speed(self.options.compute.threads or ops.get_num_threads())
                seconds = expected_seconds(plan.quality, photos, speed, self.given is None)
                self.observer.note(expected(plan.quality, photos, seconds))
                later = training_seconds(plan.quality, photos.count, speed)
                self.stages.about["training_seconds"] = later
            return plan
        photos = survey(self.sources)
        about = {"minutes": minutes, "quality": quality, "photos": asdict(photos)}
        before = self.stages.about.get("plan", {})
        if {key: before.get(key) for key in about} != about:
            threads = self.options.compute.threads or ops.get_num_threads()
            left = 60.0 * minutes - self._elapsed()
            plan = choose_plan(left, photos, measure_speed(threads), quality)
            self.stages.about["plan"] = about | {"chosen": asdict(plan)}
            self.observer.note(described(plan, photos, 60.0 * minutes))
        return MakePlan(**self.stages.about["plan"]["chosen"])

    def _make_dataset(self, plan: MakePlan) -> None:
        options = DatasetOptions(
            gather=GatherOptions(size=plan.size, photos=plan.photos, frames=plan.frames),
            sfm=SfmOptions(
                effort=plan.quality,
                threads=self.options.compute.threads,
                seconds=self.options.minutes and POSES_SHARE * 60.0 * self.options.minutes,
            ),
            marker=self.options.marker,
        )
        later = Later(self._training_seconds)
        if self.options.minutes is not None:
            later = Later(deadline=self.started + 60.0 * self.options.minutes)
        outcomes = make_dataset(
            self.sources, self.dataset.path, options, self.observer, self.overwrite, later
        )
        before = self.stages.about.get("name")
        if outcomes["photos"].again and isinstance(before, str) and Path(before).name == before:
            self.name = before  # the photos are the same, if their folder was renamed, too
        self.stages.about["name"] = self.name

    @property
    def _training_seconds(self) -> float:
        """As predicted in the first run; 0 with a time budget, and on a GPU, where the training
        takes a small part of the time."""
        seconds = self.stages.about.get("training_seconds")
        return seconds if isinstance(seconds, float) else 0.0

    def _on_cpu(self) -> bool:
        return ops.resolve_device(self.options.compute.device).type == "cpu"

    def _make_scene(self, plan: MakePlan) -> tuple[Figures, LastPart]:
        settings: dict[str, Any] = (
            {DATASET: hash_of_files(self.dataset)}
            if self.given is None
            else {"given": hash_of_dataset(self.given, self.dataset.path)}
        )
        if self.options.minutes is None:
            preset = PRESETS[plan.quality]
            settings |= {key: getattr(preset, key) for key in _TRAINING_FIELDS}
        else:
            settings["minutes"] = self.options.minutes
        settings |= {**_split(self.options), "exposure": self.options.exposure}
        if files := own_files():
            settings["import"] = files
        folder = self.folder
        outputs = [self.file, folder.point_clouds, folder.metrics]
        result = self._stage(
            "scene",
            settings,
            outputs,
            lambda: self._train(settings, plan),
            self._training_seconds,
        )
        figures = from_json(Figures, result)
        shutil.rmtree(folder.checkpoints, ignore_errors=True)  # no longer needed
        if not figures.views:
            return figures, LastPart()
        self._stage("pictures", {}, [folder.rendered("test", figures.iteration).path], self._render)
        last = self._stage("all", {}, [self.file], lambda: self._train_on_all(figures.iteration))
        return figures, from_json(LastPart, last)

    def _train(self, settings: dict[str, Any], plan: MakePlan) -> dict[str, Any]:
        """Start or resume the training; copy its scene into the output folder of `make`."""
        folder, dataset = self.folder, self.dataset.path
        options = TrainOptions(
            memory=self.options.memory,
            checkpoint_seconds=_CHECKPOINT_SECONDS,
            last_part=0.0 if self.options.hold_out is None else SHARE,
            compute=self.options.compute,
        )
        same = self.stages.about.get("training") == settings
        if same and checkpoint.exists(folder.checkpoints):
            trained = resume(folder.path, options, observer=self.observer, page=self.page)
        else:
            with one_run(folder.path):
                folder.clear()
            self.stages.about["training"] = settings
            self.stages.save()
            new = self._new_training(options, plan)
            trained = train(dataset, folder.path, new, observer=self.observer, page=self.page)
        with atomic_path(self.file) as temporary:
            shutil.copyfile(trained.scene, temporary)
        self.stages.about |= {"file": self.file.name, "last_part": False}
        verdict = trained.verdict and trained.verdict.as_json()
        figures = Figures(trained.step, 0, bool(folder.exposures()), verdict)
        if trained.evaluation is not None:
            found = folder.read_metrics()
            means = {key: found[key] for key in ("psnr", "ssim", "psnr_aligned", "size")}
            figures = replace(figures, views=len(found["views"]), **means)
        return asdict(figures)

    def _new_training(self, options: TrainOptions, plan: MakePlan) -> TrainOptions:
        settings: dict[str, Any] = {
            "leave_out_after": _LEAVE_OUT_AFTER,
            "exposure": self.options.exposure,
        }
        options = replace(options, **_split(self.options))
        if self.options.minutes is not None:
            minutes = self._minutes_left(60.0 * self.options.minutes)
            return replace(options, minutes=minutes, settings=settings)
        preset = PRESETS[plan.quality]
        settings |= {name: getattr(preset, name) for name in _TRAINING_FIELDS if name != "side"}
        dataset = self.given or read_dataset(
            DatasetSettings(str(self.dataset.path), **_split(self.options))
        )
        config = recipe(options.recipe or "default", **settings).lengthened(len(dataset.train))
        settings["iterations"] = config.iterations
        return replace(options, resolution=_width(dataset, preset), settings=settings)

    def _minutes_left(self, given: float) -> float:
        """The time for the training in minutes: the rest of ``given`` seconds, or the minimum."""
        if self.given is not None:
            photos = len(self.given.train) + len(self.given.test)
        else:
            photos = sum(path.is_file() for path in self.dataset.images.rglob("*"))
        left = given - self._elapsed()
        if self.options.hold_out is not None:
            left -= _RENDER_SECONDS * -(-photos // self.options.hold_out)
            left *= 1.0 - SHARE  # for the last part
        shortest = max(_MIN_SECONDS, _MIN_SHARE * given)
        if left < shortest:
            self.observer.inform(
                "{given} is too short: finding the camera poses took {elapsed}; training for "
                "{shortest} anyway",
                given=duration(given),
                elapsed=duration(self._elapsed()),
                shortest=duration(shortest),
            )
        return max(left, shortest) / 60.0

    def _render(self) -> dict[str, Any]:
        scene = load_trained(self.folder.path, compute=self.options.compute)
        render_images(scene, splits=("test",))
        return {}

    def _train_on_all(self, iteration: int) -> dict[str, Any]:
        """The last part; it replaces the scene file, but not the scene in the folder of the
        training, to which the metrics belong."""
        seconds = math.inf
        if self.options.minutes is not None:
            seconds = 60.0 * self.options.minutes - self._elapsed()
        compute = self.options.compute
        last, gaussians = train_on_all(self.folder, iteration, seconds, compute, self.observer)
        if gaussians is not None:
            self.stages.about["last_part"] = True
            self.stages.save()  # before the scene is written: it must not be judged by its photos
            write_gaussians(self.file, gaussians)
        return asdict(last)


def _width(dataset: Dataset, preset: Preset) -> int | None:
    """The width in pixels of the photos for training; None if they need not be reduced."""
    cameras = [view.camera for view in [*dataset.train, *dataset.test]]
    camera = max(cameras, key=lambda camera: max(camera.width, camera.height))
    longer = max(camera.width, camera.height)
    return None if longer <= preset.side else round(camera.width * preset.side / longer)
