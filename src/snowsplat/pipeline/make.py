"""`make`: make a scene from photos or a video: camera poses, training, test views, all photos.

If the input is a dataset, its camera poses are used, unless they are impossible.
"""

from __future__ import annotations

import hashlib
import math
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from snowsplat import ops
from snowsplat.data import Dataset
from snowsplat.evaluation.verdict import Verdict
from snowsplat.pipeline.all_photos import SHARE, train_on_all
from snowsplat.pipeline.given_poses import given_poses
from snowsplat.pipeline.make_plan import POSES_SHARE, MakePlan, choose_plan, described
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.make import MakeOptions
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.output.scene_files import write_gaussians
from snowsplat.pipeline.output.scene_source import load_trained
from snowsplat.pipeline.quality import PRESETS, Preset
from snowsplat.pipeline.render import render_images
from snowsplat.pipeline.run.live_page import LivePage
from snowsplat.pipeline.run.photo_stamps import stamps_of
from snowsplat.pipeline.train import resume, train
from snowsplat.project.dataset_folder import REPORT
from snowsplat.project.project import MAKE_RECORD as RECORD
from snowsplat.project.training_folder import (
    DATASET,
    SCENE,
    DatasetSettings,
    TrainingFolder,
)
from snowsplat.sfm.cost import measure_speed
from snowsplat.sfm.ingest.search.sources import find_sources
from snowsplat.sfm.make_dataset import make_dataset
from snowsplat.sfm.options import DatasetOptions, GatherOptions, SfmOptions
from snowsplat.sfm.survey import survey
from snowsplat.sfm.time_left import Later
from snowsplat.training.core import checkpoint
from snowsplat.training.settings.recipes import recipe
from snowsplat.util.duration import duration
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.files import atomic_path, remove_temporaries
from snowsplat.util.messages import message
from snowsplat.util.run_lock import LOCK, one_run
from snowsplat.util.stages import Outcome, Stages

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


@dataclass(frozen=True)
class MakeResult:
    """A finished scene.

    Attributes:
        scene: the PLY file.
        folder: the output folder of the training.
        dataset: the folder of the dataset that the scene is trained from.
        dataset_report: the HTML page about the camera poses; None if the input has poses.
        renders, photos: folders with the rendered test views and the held-out photos.
        all_photos: the number of photos of the last part of the training, which follows the
            evaluation and uses the held-out photos, too; 0 if there was none.
        left_out: the number of photos that the last part leaves out, because the scene does not
            explain them.
        psnr, ssim, psnr_aligned: means over the held-out photos, before the last part; PSNR in
            dB. If gains of exposure are learnt, the colour-aligned PSNR tells the quality. None if
            no photos were held out.
        size: of the images of which these are the means, in pixels, as text.
        views: number of held-out photos.
        exposures: whether gains of exposure are learnt.
        verdict: whether the scene is good, usable or poor, and why; None if it is not known, as for
            a scene of an earlier version.
        seconds: duration of this call.
    """

    scene: Path
    folder: TrainingFolder
    dataset: Path
    dataset_report: Path | None
    renders: Path
    photos: Path
    all_photos: int
    left_out: int
    psnr: float | None
    ssim: float | None
    psnr_aligned: float | None
    size: str
    views: int
    exposures: bool
    verdict: Verdict | None
    seconds: float


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
        _check_free(out)
        return _Job(paths, name, out, options, overwrite, observer, page, started).run()


def _check_free(out: Path) -> None:
    """Raises UserError if the folder contains files that `make` has not written."""
    remove_temporaries(out, (RECORD,))
    others = any(entry.name != LOCK for entry in out.iterdir())
    if others and not (out / RECORD).is_file():
        raise UserError("{out}: contains other files; use a new or an empty folder", out=out)


@dataclass
class _Job:
    """One call of `make`: runs the stages in their order, except for those that are finished."""

    inputs: list[Path]
    name: str
    out: Path
    options: MakeOptions
    overwrite: bool
    observer: Observer
    page: LivePage | None
    started: float  # by `time.monotonic`

    def run(self) -> MakeResult:
        self.sources = find_sources(self.inputs)
        self.stages = Stages(self.out / RECORD, STAGES)
        with self._removed_if_alone():
            self._check_inputs()
            self.given = self._given()
            self.plan = self._plan()
            self.stages.about["title"] = (
                self.options.title or self.stages.about.get("title") or self.name
            )
            self.stages.save()  # from now on, the folder is recognised as an output of `make`
            if self.given is None:
                self._make_dataset()
            # No `sfm` changes the photos during the training.
            with one_run(self.dataset) if self.given is None else nullcontext():
                return self._make_scene()

    def _check_inputs(self) -> None:
        """Raises UserError if the folder has a scene of other photos that must not be replaced."""
        inputs = [str(path.absolute()) for path in self.inputs]
        before = self.stages.about.get("inputs", inputs)
        # `make_dataset` compares the photos themselves, whose folder may have been renamed.
        compared = self.sources.posed is None and (self.out / DATASET).is_dir()
        if before != inputs and not (compared or self.overwrite):
            what = ", ".join(map(str, before)) if isinstance(before, list) else "other inputs"
            raise UserError(
                "{out}: contains a scene made from {what}; use another folder, or set `overwrite`",
                out=self.out,
                what=what,
            )
        self.stages.about["inputs"] = inputs

    def _given(self) -> Dataset | None:
        """The dataset that is the input, if its poses are used."""
        posed = self.sources.posed
        if posed is None:
            return None
        self.sources = replace(self.sources, notes=[])  # they offer the poses
        given = given_poses(self.sources, self._dataset_settings(posed), self.observer)
        if given is not None and self.options.marker is not None:
            raise SettingError(
                "marker",
                "is for poses that are estimated, and {posed} has its own; make it of the photos "
                "alone, or scale the scene afterwards: snowsplat convert --scale-to",
                posed=posed,
            )
        return given

    @contextmanager
    def _removed_if_alone(self) -> Iterator[None]:
        """If the job wrote only its record, remove it."""
        try:
            yield
        finally:
            if self.out.is_dir() and {entry.name for entry in self.out.iterdir()} <= {RECORD, LOCK}:
                (self.out / RECORD).unlink(missing_ok=True)

    def _plan(self) -> MakePlan:
        """The plan for the requested quality or time.

        The poses depend on the plan. Therefore it is recorded, and later runs use the recorded
        plan.
        """
        quality, minutes = self.options.quality, self.options.minutes
        if minutes is None or self.given is not None:
            quality = quality or "normal"
            return MakePlan(quality, PRESETS[quality].photos)
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

    def _make_dataset(self) -> None:
        plan = self.plan
        options = DatasetOptions(
            gather=GatherOptions(size=plan.size, photos=plan.photos, frames=plan.frames),
            sfm=SfmOptions(
                effort=plan.quality,
                threads=self.options.compute.threads,
                seconds=self.options.minutes and POSES_SHARE * 60.0 * self.options.minutes,
            ),
            marker=self.options.marker,
        )
        observer, later = self.observer, self._later()
        outcomes = make_dataset(
            self.sources, self.dataset, options, observer, overwrite=self.overwrite, later=later
        )
        before = self.stages.about.get("name")
        if outcomes["photos"].again and isinstance(before, str) and Path(before).name == before:
            self.name = before  # the photos are the same, if their folder was renamed, too
        self.stages.about["name"] = self.name

    def _later(self) -> Later:
        """The work after the dataset is made, for the estimate of the time left."""
        if self.options.minutes is not None:
            return Later(deadline=self.started + 60.0 * self.options.minutes)
        if ops.resolve_device(self.options.compute.device).type != "cpu":
            return Later()  # on a GPU, the training takes a small part of the time
        return Later(work=PRESETS[self.plan.quality].training)

    def _make_scene(self) -> MakeResult:
        settings: dict[str, Any] = (
            {DATASET: _fingerprint(self.dataset)}
            if self.given is None
            else {"given": _fingerprint_of(self.given, self.dataset)}
        )
        if self.options.minutes is None:
            preset = PRESETS[self.plan.quality]
            settings |= {key: getattr(preset, key) for key in _TRAINING_FIELDS}
            # Version 0.2 recorded it, and its scenes need not be made again.
            settings["stop_overfitting"] = self.plan.quality == "best"
        else:
            settings["minutes"] = self.options.minutes
        settings |= {**self._split, "exposure": self.options.exposure}
        folder = TrainingFolder(self.out / SCENE)
        outputs = [self.file, folder.path / "point_cloud", folder.metrics]
        scene = self._stage("scene", settings, outputs, lambda: self._train(settings)).result
        shutil.rmtree(folder.checkpoints, ignore_errors=True)  # no longer needed
        target = folder.rendered("test", scene["iteration"])
        whole: dict[str, Any] = {"steps": 0, "photos": 0}
        if scene["views"]:
            self._stage("pictures", {}, [target], self._render)
            whole = self._stage("all", {}, [self.file], lambda: self._train_on_all(scene)).result
        return MakeResult(
            scene=self.file,
            folder=folder,
            dataset=self.dataset,
            dataset_report=None if self.given is not None else self.dataset / REPORT,
            renders=target / "renders",
            photos=target / "gt",
            all_photos=whole["photos"],
            left_out=whole.get("left_out", 0),  # earlier versions did not say it
            psnr=scene.get("psnr"),
            ssim=scene.get("ssim"),
            psnr_aligned=scene.get("psnr_aligned"),
            size=scene.get("size", "an unknown size"),
            views=scene["views"],
            exposures=scene["exposures"],
            verdict=Verdict.from_json(scene["verdict"]),
            seconds=self._elapsed(),
        )

    @property
    def dataset(self) -> Path:
        """The folder of the dataset."""
        if self.given is not None:
            assert self.sources.posed is not None
            return self.sources.posed
        return self.out / DATASET

    @property
    def file(self) -> Path:
        """The scene file. An old file is replaced when the new scene is finished."""
        return self.out / f"{self.name}.ply"

    def _elapsed(self) -> float:
        return time.monotonic() - self.started

    def _stage(
        self,
        name: str,
        settings: dict[str, Any],
        outputs: list[Path],
        work: Callable[[], dict[str, Any]],
    ) -> Outcome:
        def on_change(reason: str) -> None:
            self.observer.note(message("{name}: repeated ({reason})", name=name, reason=reason))

        self.observer.begin(name)
        outcome = self.stages.run(name, settings, outputs, work, on_change)
        self.observer.end(name, outcome)
        return outcome

    def _train(self, settings: dict[str, Any]) -> dict[str, Any]:
        """Start or resume the training; copy its scene into the output folder of `make`."""
        folder = TrainingFolder(self.out / SCENE)
        options = TrainOptions(
            memory=self.options.memory,
            checkpoint_seconds=_CHECKPOINT_SECONDS,
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
            new = self._new_training(options)
            trained = train(self.dataset, folder.path, new, observer=self.observer, page=self.page)
        with atomic_path(self.file) as temporary:
            shutil.copyfile(trained.scene, temporary)
        self.stages.about |= {"file": self.file.name, "last_part": False}
        result: dict[str, Any] = {"iteration": trained.step, "views": 0}
        if trained.evaluation is not None:
            metrics = folder.read_metrics()
            result |= {key: metrics[key] for key in ("psnr", "ssim", "psnr_aligned", "size")}
            result["views"] = len(metrics["views"])
        return result | {
            "exposures": bool(folder.exposures()),
            "verdict": trained.verdict and trained.verdict.as_json(),
        }

    def _new_training(self, options: TrainOptions) -> TrainOptions:
        settings: dict[str, Any] = {
            "leave_out_after": _LEAVE_OUT_AFTER,
            "exposure": self.options.exposure,
        }
        options = replace(options, **self._split)
        if self.options.minutes is not None:
            minutes = self._minutes_left(60.0 * self.options.minutes)
            return replace(options, minutes=minutes, settings=settings)
        preset = PRESETS[self.plan.quality]
        settings |= {name: getattr(preset, name) for name in _TRAINING_FIELDS if name != "side"}
        dataset = self.given or self._dataset_settings(self.dataset).load()
        config = recipe(options.recipe or "default", **settings).lengthened(len(dataset.train))
        settings["iterations"] = config.iterations
        return replace(options, resolution=_width(dataset, preset), settings=settings)

    def _dataset_settings(self, dataset: Path) -> DatasetSettings:
        return DatasetSettings(str(dataset), **self._split)

    @property
    def _split(self) -> dict[str, Any]:
        """Every N-th photo is held out, from the middle of the first N on: the first photo of a
        walk is at its end, and shows places that no other photo shows, so it says little."""
        every = self.options.hold_out
        return {"hold_out": every, "first_held_out": (every or 0) // 2}

    def _train_on_all(self, scene: dict[str, Any]) -> dict[str, Any]:
        """The last part; it replaces the scene file, but not the scene in the folder of the
        training, to which the metrics belong."""
        seconds = math.inf
        if self.options.minutes is not None:
            seconds = 60.0 * self.options.minutes - self._elapsed()
        folder = TrainingFolder(self.out / SCENE)
        compute = self.options.compute
        last = train_on_all(folder, scene["iteration"], seconds, compute, self.observer)
        if last.gaussians is not None:
            self.stages.about["last_part"] = True
            self.stages.save()  # before the scene is written: it must not be judged by its photos
            write_gaussians(self.file, last.gaussians)
        return {name: getattr(last, name) for name in ("steps", "photos", "left_out", "why_not")}

    def _minutes_left(self, given: float) -> float:
        """The time for the training in minutes: the rest of ``given`` seconds, or the minimum."""
        if self.given is not None:
            photos = len(self.given.train) + len(self.given.test)
        else:
            photos = sum(path.is_file() for path in (self.dataset / "images").rglob("*"))
        left = given - self._elapsed()
        if self.options.hold_out is not None:
            left -= _RENDER_SECONDS * -(-photos // self.options.hold_out)
            left *= 1.0 - SHARE  # for the last part
        shortest = max(_MIN_SECONDS, _MIN_SHARE * given)
        if left < shortest:
            self.observer.note(
                message(
                    "{given} is too short: finding the camera poses took {elapsed}; training for "
                    "{shortest} anyway",
                    given=duration(given),
                    elapsed=duration(self._elapsed()),
                    shortest=duration(shortest),
                )
            )
        return max(left, shortest) / 60.0

    def _render(self) -> dict[str, Any]:
        scene = load_trained(self.out / SCENE, compute=self.options.compute)
        render_images(scene, splits=("test",))
        return {}


def _width(dataset: Dataset, preset: Preset) -> int | None:
    """The width in pixels of the photos for training; None if they need not be reduced."""
    cameras = [view.camera for view in [*dataset.train, *dataset.test]]
    camera = max(cameras, key=lambda camera: max(camera.width, camera.height))
    longer = max(camera.width, camera.height)
    return None if longer <= preset.side else round(camera.width * preset.side / longer)


def _fingerprint_of(dataset: Dataset, folder: Path) -> str:
    """A hash of the cameras and points of a dataset, and of its photos and masks."""
    digest = hashlib.sha256()
    for view in [*dataset.train, *dataset.test]:
        camera = view.camera
        intrinsics = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        pose = camera.cam_from_world.tolist()
        digest.update(repr((view.name, intrinsics, pose, view.image.view)).encode())
    if dataset.points is not None:
        digest.update(dataset.points.xyz.numpy().tobytes())
    stamps = stamps_of(dataset, folder)
    digest.update(repr(sorted((k, v.size, v.digest) for k, v in stamps.items())).encode())
    return digest.hexdigest()


def _fingerprint(dataset: Path) -> str:
    """A hash of the cameras, and of the names and sizes of photos and masks."""
    digest = hashlib.sha256()
    for path in sorted((dataset / "sparse" / "0").glob("*.bin")):
        digest.update(path.read_bytes())
    for folder in ("images", "masks"):
        for path in sorted((dataset / folder).rglob("*")):
            if path.is_file():
                digest.update(f"{path.relative_to(dataset)} {path.stat().st_size}\n".encode())
    return digest.hexdigest()
