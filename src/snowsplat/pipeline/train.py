"""`train` and `resume`: train a scene from a dataset and write it to an output folder."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from snowsplat.data import Dataset, read_dataset, read_undamaged
from snowsplat.ops import device_name
from snowsplat.pipeline.compute import Compute, open_device
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.run.dataset_check import check_cameras, edited, stamps_of
from snowsplat.pipeline.run.live_page import LivePage
from snowsplat.pipeline.run.processes import Setup, count, follow, joined
from snowsplat.pipeline.run.results import TrainResult
from snowsplat.pipeline.run.training_files import CheckpointMeta, write_beginning
from snowsplat.pipeline.run.training_run import Request, TrainingRun
from snowsplat.project.project import Project
from snowsplat.project.training_folder import DatasetSettings, TrainingFolder
from snowsplat.training.budgets.memory_budget import MemoryPlan, plan_memory
from snowsplat.training.budgets.pace import Pace, TimeBudget
from snowsplat.training.budgets.step_cost import Work
from snowsplat.training.budgets.time_plan import Plan, make_plan, measure_time_ratio
from snowsplat.training.core import checkpoint
from snowsplat.training.core.checkpoint import Checkpoint
from snowsplat.training.core.run import Loss
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.parts.list import all_parts_of, hints
from snowsplat.training.parts.part import Part
from snowsplat.training.processes.shards import ALONE, Shards
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.names import changed
from snowsplat.training.settings.schedule import Schedule
from snowsplat.training.settings.stored import config_from_json, config_to_json
from snowsplat.util.byte_size import format_bytes
from snowsplat.util.duration import duration
from snowsplat.util.errors import UserError
from snowsplat.util.machine import reset_peak, resident_bytes
from snowsplat.util.messages import Message, message
from snowsplat.util.run_lock import one_run

logger = logging.getLogger(__name__)

# Of a Gaussian of SH degree 3 in a PLY file: 62 float32.
_BYTES_IN_FILE = 248
# Settings that may be changed when a training run is resumed.
_FREE_ON_RESUME = {"iterations", "test_iterations", "checkpoint_every"}


def train(
    dataset: Path | str,
    output: Path | str,
    options: TrainOptions | None = None,
    *,
    overwrite: bool = False,
    observer: Observer = SILENT,
    page: LivePage | None = None,
    parts: Sequence[Part] = (),
    loss: Loss | None = None,
) -> TrainResult:
    """Train a scene from a dataset.

    Args:
        dataset: a folder with photos and their cameras, see `snowsplat.data.load_dataset`.
        output: the output folder, see `snowsplat.project.training_folder`. It is created if
            it does not exist.
        overwrite: replace the results of an earlier training run in ``output``.
        page: shows the training in the browser.
        parts: further parts of the training, after those of the configuration; see
            `snowsplat.training.parts.part.Part`.
        loss: compares an image with a photo, instead of L1 and D-SSIM; see `Trainer`.

    Returns:
        The files of the scene, and statistics of the training run.

    Raises:
        UserError: an unusable dataset, impossible cameras (see `TrainOptions`); an unusable
            setting, device or folder; another run in ``output``; too little memory; a loss or
            parameters that are not finite. A new folder is removed if it contains no results.
        TrainingStopped: Ctrl-C. Scene and checkpoint are saved; `resume` continues.
        KeyboardInterrupt: Ctrl-C before the first step; nothing is saved.
    """
    options = options or TrainOptions()
    options.configuration()  # reports an invalid setting first
    request = Request(TrainingFolder(Path(output)), options, observer, page, parts, loss)
    with _job(request, resume=False, overwrite=overwrite) as job:
        return job.train(dataset)


def resume(
    output: Path | str,
    options: TrainOptions | None = None,
    *,
    dataset: Path | str | None = None,
    observer: Observer = SILENT,
    page: LivePage | None = None,
    parts: Sequence[Part] = (),
    loss: Loss | None = None,
) -> TrainResult:
    """Continue a training run from its newest checkpoint. The result is the same as without the
    interruption (on a GPU: only with `Compute.deterministic`).

    Args:
        output: the output folder of the training run.
        options: these may change ``minutes``, the settings iterations, test_iterations and
            checkpoint_every, and options that do not affect the result. All other options must be
            the same as before.
        dataset: the folder of the dataset, if it was moved. If there is no checkpoint yet, the
            training starts at step 0 with this dataset.
        parts, loss: new objects of the same kinds as before.

    Returns:
        As `train`.

    Raises:
        UserError: as `train`; or there is neither a checkpoint nor ``dataset``; or settings have
            changed that must not change.
        TrainingStopped, KeyboardInterrupt: see `train`.
    """
    options = options or TrainOptions()
    request = Request(TrainingFolder(Path(output)), options, observer, page, parts, loss)
    with _job(request, resume=True, overwrite=False) as job:
        return job.resume(dataset)


def follow_training(compute: Compute, parts: Sequence[Part] = (), loss: Loss | None = None) -> None:
    """Take part in the training of process 0; for the other processes. Returns at its end.

    ``parts`` and ``loss`` are as those of process 0.
    Raises: ProcessLost: process 0 or another process has ended with an error.
    """
    device = compute.apply()
    with joined(device) as shards:
        follow(shards, device, parts, loss)


@contextmanager
def _job(request: Request, *, resume: bool, overwrite: bool) -> Iterator[_Job]:
    with one_run(request.out.path):
        request.out.check_free(resume=resume, overwrite=overwrite)
        job = _Job(request)
        with joined(job.device) as job.shards:
            yield job


class _Job:
    """One call of `train` or `resume`: prepares a `TrainingRun` and runs it."""

    def __init__(self, request: Request) -> None:
        if request.page is not None and count() > 1:
            raise UserError("the page needs one process; leave out `view`, and use snowsplat watch")
        self.request, self.out, self.options = request, request.out, request.options
        self.note, self.inform = request.observer.note, request.observer.inform
        self.device = self.options.compute.apply()
        open_device(self.device)
        reset_peak()
        self.memory_before = resident_bytes()
        self.shards: Shards = ALONE
        self.doubts: tuple[Message, ...] = ()  # about the dataset

    def train(self, path: Path | str) -> TrainResult:
        options = self.options
        settings = options.dataset_settings(path)
        name = "custom" if options.config is not None else options.recipe or "default"
        config = options.configuration()
        settings, files = read_undamaged(settings)
        dataset = files.dataset(settings.resolution)
        if options.minutes is None:  # too little memory is refused before the photos are compared
            plan_memory(dataset, config, self.device, budget=options.memory)
        trusted = options.trust_cameras
        self.doubts, wrong = check_cameras(dataset, settings.path, trusted=trusted)
        if wrong:
            settings, files = replace(settings, left_out=wrong), files.without(wrong)
            dataset = files.dataset(settings.resolution)
        budget, plan = self._budget(), None
        if budget is not None:
            plan = self._plan(dataset, config, budget)
            config = plan.config
            if plan.resolution is not None:
                settings = replace(settings, resolution=plan.resolution)
                dataset = files.dataset(plan.resolution)
        elif options.iterations is None:
            config = config.lengthened(len(dataset.train))
        memory = plan_memory(dataset, config, self.device, budget=options.memory)
        self.note(_described(dataset))
        if budget is not None and plan is not None:
            time = duration(budget.seconds)
            self.inform("{time} on this machine: {plan}", time=time, plan=plan.summary())
        if "sweep" in config.starts:
            self.inform("computing depth maps for the initialisation")
        self.photos = stamps_of(dataset, settings.path)
        self.shards.of_first(Setup(settings, memory.config))
        trainer = self._trainer(dataset, memory.config)
        if options.config is None:
            for hint in hints(trainer, options.settings):
                self.note(hint)
        self.out.remove_results()
        write_beginning(self.out, dataset, settings, memory.config)
        return self._run(settings, name, trainer, memory, budget, plan)

    def resume(self, path: Path | str | None) -> TrainResult:
        start = self._newest_checkpoint(path)
        if start is None:
            assert path is not None
            return self.train(path)
        options, meta = self.options, CheckpointMeta.from_checkpoint(start)
        budget, schedule = None, None
        if options.iterations is None:  # `iterations` replaces the time budget and its schedule
            budget, schedule = self._budget(meta.time), meta.schedule
        meta = replace(meta, dataset=self.out.located(meta.dataset))
        settings = _resumed_dataset(options, path, start, meta)
        config = _resumed_config(options, start, meta)
        dataset = read_dataset(settings)
        # The first run has refused impossible cameras, or not.
        self.doubts, _ = check_cameras(dataset, settings.path, trusted=True)
        self._compare_photos(dataset, settings.path, meta)
        means = start.tensors.get("gaussians.means")  # checked when the state is loaded
        present = 0 if means is None else means.numel() // 3
        memory = plan_memory(dataset, config, self.device, budget=options.memory, present=present)
        self.shards.of_first(Setup(settings, memory.config, schedule, start.path))
        trainer = self._trainer(dataset, memory.config, schedule, start.tensors)
        start.arrays.clear()  # the trainer has a copy, which is the one in the memory plan
        self.out.write_settings(settings, config_to_json(memory.config))
        self.note(_described(dataset))
        self.inform(
            "resuming from {path}, step {step} of {iterations}",
            path=start.path,
            step=start.step,
            iterations=trainer.schedule.iterations,
        )
        return self._run(settings, meta.recipe, trainer, memory, budget)

    def _budget(self, before: dict[str, float] | None = None) -> TimeBudget | None:
        """The time budget; None if no time was requested, now or in an earlier run.

        The requested time of a resumed run is that for the remaining steps. ``before``: the budget
        in its checkpoint, see `TimeBudget.as_json`.
        """
        minutes, started = self.options.minutes, self.request.started
        if minutes is not None:
            return TimeBudget(60.0 * minutes, started=started)
        return None if before is None else TimeBudget(**before, started=started)

    def _plan(self, dataset: Dataset, config: TrainConfig, budget: TimeBudget) -> Plan:
        """The number of steps, the photo size and the limit of Gaussians for the time that is left.

        The speed is measured with a separate, short training run. The `Trainer` of the real run
        cannot be used, because its resolution, limit and schedule depend on the plan.
        """
        options, resize = self.options, self.options.resolution is None

        def is_free(*settings: str) -> bool:
            given = any(options.settings.get(each) is not None for each in settings)
            return options.config is None and not given

        time_ratio = measure_time_ratio(dataset, config, self.device, resize=resize)
        return make_plan(
            dataset,
            config,
            budget.left,
            time_ratio,
            resize=resize,
            more_gaussians=is_free("max_gaussians"),
            more_often=is_free("densify_interval", "densify_from"),
        )

    def _compare_photos(self, dataset: Dataset, path: str, meta: CheckpointMeta) -> None:
        """Warn if photos or masks were edited since the training has begun."""
        self.photos = stamps_of(dataset, path, meta.photos)
        if meta.photos is not None and (names := edited(meta.photos, self.photos)):
            text = message(
                "{edited} of {all} photos and masks were edited after the first step (such as "
                "{name}); the result is not that of either version; train in a new folder to use "
                "the edited ones only",
                edited=len(names),
                all=len(self.photos),
                name=names[0],
            )
            self.doubts = (*self.doubts, text)
            logger.warning("warning: %s: %s", path, text)

    def _trainer(
        self,
        dataset: Dataset,
        config: TrainConfig,
        schedule: Schedule | None = None,
        state: dict[str, Tensor] | None = None,
    ) -> Trainer:
        return Trainer(
            dataset,
            config,
            schedule,
            self.device,
            state,
            shards=self.shards,
            parts=[*all_parts_of(config), *self.request.parts],
            loss=self.request.loss,
            note=self.note,
        )

    def _run(
        self,
        settings: DatasetSettings,
        recipe: str,
        trainer: Trainer,
        memory: MemoryPlan,
        budget: TimeBudget | None,
        plan: Plan | None = None,
    ) -> TrainResult:
        device, plan_text = device_name(self.device), memory.summary()
        self.inform("training on {device_name}; {memory}", device_name=device, memory=plan_text)
        most = _BYTES_IN_FILE * (memory.limit or len(trainer.gaussians))
        if (free := shutil.disk_usage(self.out.path).free) < most:
            self.inform(
                "only {free} are free on the disk, and the scene may need {most}: free some space",
                free=format_bytes(free),
                most=format_bytes(most),
            )
        last_part = self.request.options.last_part
        work = Work.for_training(trainer.config, trainer.dataset, last_part)
        pace = Pace(work)
        if budget is not None:
            pace = Pace(work, budget.left, plan.time_ratio if plan else 1.0)
        run = TrainingRun(
            self.request,
            settings,
            recipe,
            trainer,
            memory,
            self.memory_before,
            budget,
            pace,
            self.doubts,
            self.photos,
        )
        if (page := self.request.page) is not None:
            page.open_training(trainer, Project.open(self.out.path).name, self.request.observer)
        return run.run()

    def _newest_checkpoint(self, path: Path | str | None) -> Checkpoint | None:
        """The newest checkpoint; None if there is none, so that training starts at step 0."""
        out = self.out
        newest = checkpoint.latest(out.checkpoints)
        if newest is not None:
            return newest
        if path is None:
            raise UserError(
                "{path}: contains no complete checkpoint to resume; add the dataset to start "
                "from step 0",
                path=out.path,
            )
        if out.scenes() or checkpoint.exists(out.checkpoints):
            what = message("a scene") if out.scenes() else message("checkpoints")
            raise UserError(
                "{path}: contains {what} but no complete checkpoint to resume; use `overwrite` "
                "instead of `resume` to start from step 0",
                path=out.path,
                what=what,
            )
        self.inform("{path}: no checkpoint yet; starting at step 0", path=out.path)
        return None


def _resumed_dataset(
    options: TrainOptions, path: Path | str | None, start: Checkpoint, meta: CheckpointMeta
) -> DatasetSettings:
    """The settings of the checkpoint, with new paths of the dataset and of the test list.

    Raises UserError if another setting has changed.
    """

    def relevant(settings: DatasetSettings) -> tuple[Any, ...]:
        resolution = max(1, settings.resolution)  # -1 is full resolution too
        tests = settings.test_list
        tests = Path(tests).name if isinstance(tests, str) else tests
        split = settings.hold_out, settings.first_held_out, tests
        return settings.images, resolution, split

    settings = options.dataset_settings(path, meta.dataset)
    if relevant(settings) != relevant(meta.dataset):
        raise _other_settings(start)
    return settings


def _resumed_config(options: TrainOptions, start: Checkpoint, meta: CheckpointMeta) -> TrainConfig:
    """The configuration of the checkpoint, with changes that do not affect the finished steps.

    Raises UserError if another setting has changed.
    """
    config = config_from_json(meta.training)
    if options.recipe not in (None, meta.recipe):
        raise UserError(
            "{path}: was made with the recipe {recipe}; resume without `recipe`",
            path=start.path,
            recipe=meta.recipe,
        )
    resumed = changed(options.config or config, **options.settings)
    same = replace(resumed, **{name: getattr(config, name) for name in _FREE_ON_RESUME})
    if same != config:
        raise _other_settings(start)
    # This is checked only if `iterations` is given: the checkpoint of a training run with a time
    # budget has the number of the first plan, and the run may have done more steps.
    if options.iterations is not None and resumed.iterations < start.step:
        raise UserError(
            "{path}: is from step {step}, after `iterations` {iterations}; use a larger number",
            path=start.path,
            step=start.step,
            iterations=resumed.iterations,
        )
    return resumed


def _other_settings(start: Checkpoint) -> UserError:
    return UserError(
        "{path}: was made with other settings; resume without changing the training "
        "(`iterations`, `test_iterations`, `checkpoint_every` may change)",
        path=start.path,
    )


def _described(dataset: Dataset) -> Message:
    camera = dataset.train[0].camera
    points = message("no points")
    if dataset.points is not None:
        points = message("{count:,} points", count=len(dataset.points))
    photos = message("{count} photos to train on", count=len(dataset.train))
    if masks := sum(view.mask is not None for view in dataset.train):
        photos = message("{photos} ({masks} with masks)", photos=photos, masks=masks)
    return message(
        "{dataset}: {photos}, {held_out} held out, {width}x{height}, {points}",
        dataset=dataset.description,
        photos=photos,
        held_out=len(dataset.test),
        width=camera.width,
        height=camera.height,
        points=points,
    )
