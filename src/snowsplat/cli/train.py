"""`snowsplat train`: a posed dataset becomes a scene."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from snowsplat.cli.computing import ask_for_the_same_bits, compute_with
from snowsplat.cli.flags import flag, switch
from snowsplat.cli.progress import resident_bytes
from snowsplat.cli.viewing import PageFlags
from snowsplat.pipeline.memory import MemoryBudget
from snowsplat.pipeline.output_folder import DatasetSettings, OutputFolder
from snowsplat.pipeline.timed import TimeBudget
from snowsplat.pipeline.train import TrainingRun
from snowsplat.training.step_schedule import Schedule
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import from_json

if TYPE_CHECKING:
    from snowsplat.data import Dataset
    from snowsplat.training.checkpoint import Checkpoint
    from snowsplat.training.config import TrainConfig
    from snowsplat.training.trainer import Trainer

# Flags that are knobs of the configuration, under the same name.
_KNOBS = (
    *("iterations", "seed", "background", "sh_degree", "ssim_weight", "test_iterations"),
    *("max_gaussians", "grad_threshold", "densify_from", "densify_until", "densify_interval"),
    *("percent_dense", "opacity_reset_interval", "initial_points", "checkpoint_every"),
    *("lr_means", "lr_means_final", "lr_means_steps", "lr_log_scales", "lr_quats"),
    *("lr_opacity_logits", "lr_sh_dc", "lr_sh_rest"),
)
# Those that may differ from what a checkpoint was made with, without being another training.
_FREE_ON_RESUME = {"iterations", "test_iterations", "checkpoint_every"}

RECIPE = "the recipe's"


@dataclass(frozen=True)
class Noted:
    """What a checkpoint says of its training, beside the numbers."""

    capture: DatasetSettings  # the key in the file
    recipe: Literal["default", "paper", "mcmc"]
    training: dict[str, Any]  # see `config_from_json`
    time: dict[str, float] | None = None  # see `TimeBudget`
    schedule: Schedule | None = None


def read_meta(start: Checkpoint) -> Noted:
    """What stands in a checkpoint, checked.

    Raises:
        UserError: not of a training, or damaged.
    """
    try:
        noted = from_json(Noted, start.meta)
        if noted.time is not None and noted.time.keys() != {"seconds", "spent"}:
            raise ValueError("no time")
    except ValueError as error:
        raise UserError(f"{start.path}: not the checkpoint of a training ({error})") from None
    return noted


def _other_settings(start: Checkpoint) -> UserError:
    return UserError(
        f"{start.path}: was made with other settings; resume without flags that change the "
        "training (--iterations, --test-iterations, --checkpoint-every may change)"
    )


def _gaussians_in(start: Checkpoint) -> int:
    means = start.tensors.get("gaussians.means")  # what stands there is checked when it is loaded
    return 0 if means is None else means.numel() // 3


@dataclass
class Train:
    """Train a scene from photos whose cameras are known (COLMAP, or transforms.json).

    Examples:
      snowsplat train garden -o out                   3000 steps, some minutes on a laptop
      snowsplat train garden -o out --eval            hold out every 8th photo, measure on them
      snowsplat train garden -o out -r 4              photos at a quarter of their size: quicker
      snowsplat train garden -o out --minutes 5       the best that 5 minutes allow here
      snowsplat train garden -o out --recipe paper    the 30,000 steps of the paper
      snowsplat train garden -o out --checkpoint-every 1000
      snowsplat train -o out --resume                 go on after Ctrl-C, a crash, a power cut

    The scene is OUT/point_cloud/iteration_N/point_cloud.ply. Ctrl-C saves what is reached. The
    flags of the reference implementation are understood (-s -m -i -r -w --eval --iterations …).
    """

    dataset: Annotated[Path | None, tyro.conf.Positional, flag("DATASET")] = None
    """Folder of photos and cameras: images/ and sparse/0/ of COLMAP, or transforms.json."""
    output: Annotated[Path | None, flag("OUT", "-o", "-m", "--model-path")] = None
    """Folder for the result; made if it is not there."""

    recipe: Annotated[
        Literal["default", "paper", "mcmc"] | None,
        flag("{default,paper,mcmc}", default="default"),
    ] = None
    """Where all other settings come from. default: a few thousand quick steps; paper: the schedule
    of the paper, 30,000 steps; mcmc: 30,000 steps with a fixed number of Gaussians."""
    iterations: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Training steps, one photo each."""
    minutes: Annotated[float | None, flag("F", default="none")] = None
    """End after this time, measuring and saving included: picks steps, size of photos and number of
    Gaussians to fit, but for those that are named. With --resume: the time for what is left."""
    eval: Annotated[bool, switch()] = False
    """Hold out every 8th photo (or the dataset's own test split) and measure on it at the end."""
    test_list: Annotated[Path | None, flag("FILE")] = None
    """Text file naming the photos to hold out instead, one a line. Means --eval."""
    images: Annotated[str | None, flag("NAME", "-i", default="images")] = None
    """Name of the folder of photos in the dataset."""
    resolution: Annotated[int | None, flag("N", "-r", default="as they are")] = None
    """1, 2, 4 or 8 divide the size of the photos; any other number is the width to be had."""
    background: Annotated[
        Literal["black", "white", "random"] | None,
        flag("{black,white,random}", default="black"),
    ] = None
    """Colour behind the scene, and behind transparent photos."""
    white_background: Annotated[bool, switch("-w")] = False
    """The same as --background white."""

    view: Annotated[bool, switch()] = False
    """Watch the training in a browser: the scene as it grows, curves, pause. Ctrl-C ends it."""
    port: Annotated[int | None, flag("N", default="8080, or the next that is free")] = None
    """Where that page is: http://localhost:N."""
    host: Annotated[str | None, flag("H", default="127.0.0.1, this computer alone")] = None
    """Who may look; 0.0.0.0: all in the network who have the address, which is printed."""

    max_gaussians: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Most Gaussians that the scene may have: memory and time follow it. 0: no limit."""
    memory: Annotated[str | None, flag("BYTES", default="what is there")] = None
    """Memory to train in, like 4GB: of the GPU, or of the computer, beside what Python and PyTorch
    take for themselves. Photos are read anew for each use, and Gaussians are fewer, as needed."""
    checkpoint_every: Annotated[int | None, flag("N", default="none")] = None
    """Steps between checkpoints, from which --resume goes on exactly."""
    resume: Annotated[bool, switch()] = False
    """Go on from the newest checkpoint in OUT, to the same result as without the stop."""
    overwrite: Annotated[bool, switch()] = False
    """Replace a training that is in OUT."""
    device: Annotated[str | None, flag("{cuda,cuda:N,cpu}", default="a GPU if there is one")] = None
    """What to compute on."""
    threads: Annotated[int | None, flag("N", default="all cores")] = None
    """Threads to compute with, on the CPU. The result is the same with any number."""
    deterministic: Annotated[bool, switch()] = False
    """On a GPU: the same scene to the bit every time, which takes more time and memory."""
    seed: Annotated[int | None, flag("N", default="0")] = None
    """Of all random choices. The same seed gives the same scene: on the CPU, and on a GPU with
    --deterministic, to the bit."""
    test_iterations: Annotated[tuple[int, ...] | None, flag("[N ...]", default=RECIPE)] = None
    """Steps after which to measure on the held-out photos as well; -1 or nothing for none."""
    save_iterations: Annotated[tuple[int, ...], flag("[N ...]")] = ()
    """Steps after which to save the scene as well as at the end."""

    sh_degree: Annotated[int | None, flag("{0,1,2,3}", default="3")] = None
    """How far colours may change with the direction of view; less takes less memory."""
    ssim_weight: Annotated[float | None, flag("F", "--lambda-dssim", default=RECIPE)] = None
    """Share of 1 - SSIM in the loss; the rest is the mean absolute difference."""
    initial_points: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Random Gaussians to begin with where the dataset has no points."""
    grad_threshold: Annotated[
        float | None, flag("F", "--densify-grad-threshold", default=RECIPE)
    ] = None
    """Gaussians are added where the view-space gradient is larger. Raise it for fewer Gaussians."""
    densify_interval: Annotated[
        int | None, flag("N", "--densification-interval", default=RECIPE)
    ] = None
    """Steps between densifications. Raise it for fewer Gaussians."""
    densify_from: Annotated[
        int | float | None, flag("N|F", "--densify-from-iter", default=RECIPE)
    ] = None
    """First step that may densify; with a point (0.1), that share of all steps."""
    densify_until: Annotated[
        int | float | None, flag("N|F", "--densify-until-iter", default=RECIPE)
    ] = None
    """Last step that may densify; with a point (0.5), that share of all steps."""
    opacity_reset_interval: Annotated[int | None, flag("N", default=RECIPE)] = None
    """Steps between resets of opacity; 0: none."""
    percent_dense: Annotated[float | None, flag("F", default=RECIPE)] = None
    """Gaussians smaller than this share of the scene's extent are cloned, larger ones split."""
    lr_means: Annotated[float | None, flag("F", "--position-lr-init", default=RECIPE)] = None
    """Learning rate of the positions at the first step, in extents of the scene."""
    lr_means_final: Annotated[float | None, flag("F", "--position-lr-final", default=RECIPE)] = None
    """… and at the last."""
    lr_means_steps: Annotated[
        int | float | None, flag("N|F", "--position-lr-max-steps", default=RECIPE)
    ] = None
    """The step that counts as the last for it."""
    lr_log_scales: Annotated[float | None, flag("F", "--scaling-lr", default=RECIPE)] = None
    """Learning rate of the sizes."""
    lr_quats: Annotated[float | None, flag("F", "--rotation-lr", default=RECIPE)] = None
    """Learning rate of the rotations."""
    lr_opacity_logits: Annotated[float | None, flag("F", "--opacity-lr", default=RECIPE)] = None
    """Learning rate of the opacities."""
    lr_sh_dc: Annotated[float | None, flag("F", default=RECIPE)] = None
    """Learning rate of the colours."""
    lr_sh_rest: Annotated[float | None, flag("F", default=RECIPE)] = None
    """Learning rate of the colours' change with direction."""
    feature_lr: Annotated[float | None, flag("F", default=RECIPE)] = None
    """Both of them: --lr-sh-dc F --lr-sh-rest F/20, as in the reference."""
    source_path: Annotated[Path | None, flag("DATASET", "-s")] = None
    """The reference's way to name the dataset."""
    quiet: Annotated[bool, switch("-q")] = False
    """No progress, only the result."""
    checkpoint_seconds: Annotated[float | None, tyro.conf.Suppress] = None
    """For callers from Python: seconds between checkpoints, instead of steps."""
    again: Annotated[str | None, tyro.conf.Suppress] = None
    """For callers from Python: the command that goes on with a training that was stopped."""
    stay: Annotated[bool, tyro.conf.Suppress] = True
    """For callers from Python: keep the page of --view open until Ctrl-C."""

    def run(self) -> int:
        """Gives the exit code: 0, or 130 after Ctrl-C (with the scene and a checkpoint saved)."""
        started = time.monotonic()
        if self.output is None:
            raise UserError("train needs a folder for the result; add -o OUT")
        if self.resume and self.overwrite:
            raise UserError("--resume and --overwrite exclude each other; leave one out")
        if self.minutes is not None and self.iterations is not None:
            raise UserError("--minutes and --iterations both say when to end; leave one out")
        PageFlags(self.port, self.host).check(self.view)
        out = OutputFolder(self.output)
        out.check_free(resume=self.resume, overwrite=self.overwrite)
        if not self.resume and self._dataset_path() is None:
            raise UserError(
                "train needs a dataset; name the folder of the photos and their cameras"
            )

        from snowsplat.training.trainer import Trainer

        device = compute_with(self.threads, self.device)
        before = resident_bytes()
        if self.deterministic:
            ask_for_the_same_bits()
        start = self._checkpoint(out) if self.resume else None
        noted = None if start is None else read_meta(start)
        budget, schedule = self._length(noted, started)
        slowness = 1.0
        if start is None or noted is None:
            settings, config = self._dataset_settings(None), self._config()
            recipe = self.recipe or "default"
        else:
            settings = self._resumed_settings(start, noted)
            config, recipe = self._resumed_config(start, noted), noted.recipe
        dataset = settings.load()
        if budget is not None and start is None:
            plan = budget.plan(
                *(dataset, config, device),
                resize=self.resolution is None,
                more_gaussians=self.max_gaussians is None,
                more_often=self.densify_interval is None and self.densify_from is None,
            )
            config, slowness = plan.config, plan.slowness
            if plan.resolution is not None:
                settings = replace(settings, resolution=plan.resolution)
                dataset = settings.load()
        present = 0 if start is None else _gaussians_in(start)
        memory = MemoryBudget.of(self.memory, dataset, config, device, before, present)
        config = memory.plan.config
        trainer = Trainer(dataset, config, schedule, device)
        if start is None:
            out.begin(dataset, settings, config)
        else:
            trainer.load_state(start.tensors)
            start.tensors.clear()  # it has copied them, and they are no part of what it takes
            out.write_config(settings, config)
        self._describe(dataset, trainer, start)
        if budget is not None and start is None:
            self._say(budget.described(plan))
        self._say(str(memory))
        pace = None if budget is None else budget.pace(trainer, slowness)
        run = TrainingRun(
            *(out, settings, recipe, trainer, budget, pace, memory),
            save_iterations=self.save_iterations,
            checkpoint_seconds=self.checkpoint_seconds,
            again=self.again or f"snowsplat train -o {self.output} --resume",
            quiet=self.quiet,
        )
        return self._viewed(run) if self.view else run.run()

    def _viewed(self, run: TrainingRun) -> int:
        """Run it with a page, which stays when it is over."""
        run.viewer = PageFlags(self.port, self.host).open_for(run.trainer, run.out.path.name)
        try:
            code = run.run()
            if code == 0 and self.stay:
                with suppress(KeyboardInterrupt):
                    print(f"the scene stays at {run.viewer.viewer.url} until Ctrl-C", flush=True)
                    run.viewer.end(run.trainer.step, run.trainer.gaussians)
            return code
        finally:
            run.viewer.viewer.close()

    # Flags -> settings

    def _length(
        self, noted: Noted | None, started: float
    ) -> tuple[TimeBudget | None, Schedule | None]:
        """The time that there is, and the schedule of a training that goes on.

        --iterations, given anew, takes the place of both.
        """
        if noted is None or self.iterations is not None:
            return TimeBudget.of(self.minutes, None, started), None
        return TimeBudget.of(self.minutes, noted.time, started), noted.schedule

    def _dataset_path(self) -> Path | None:
        if self.dataset is not None and self.source_path is not None:
            raise UserError("the dataset is named twice; leave out -s or the other")
        return self.dataset or self.source_path

    def _dataset_settings(self, before: DatasetSettings | None) -> DatasetSettings:
        """From the flags; what they leave open is as it was ``before``."""
        path = self._dataset_path()
        settings = before or DatasetSettings(path="")
        changes: dict[str, Any] = {
            "path": None if path is None else str(path.absolute()),
            "images": self.images,
            "resolution": self.resolution,
            "hold_out": 8 if self.eval or self.test_list is not None else None,
            "test_list": None if self.test_list is None else str(self.test_list.absolute()),
        }
        return replace(settings, **{k: v for k, v in changes.items() if v is not None})

    def _resumed_settings(self, start: Checkpoint, noted: Noted) -> DatasetSettings:
        """The checkpoint's own; where the dataset and the list of tests are may have changed."""

        def matters(settings: DatasetSettings) -> tuple[Any, ...]:
            resolution = max(1, settings.resolution)  # -1 is as they are, too
            tests = settings.test_list and Path(settings.test_list).name
            return settings.images, resolution, settings.hold_out, tests

        settings = self._dataset_settings(noted.capture)
        if matters(settings) != matters(noted.capture):
            raise _other_settings(start)
        return settings

    def _knobs(self) -> dict[str, Any]:
        knobs = {name: getattr(self, name) for name in _KNOBS}
        if self.white_background:
            if self.background not in (None, "white"):
                raise UserError("-w and --background name different colours; leave one out")
            knobs["background"] = "white"
        if self.feature_lr is not None:
            knobs["lr_sh_dc"] = self.feature_lr if self.lr_sh_dc is None else self.lr_sh_dc
            rest = self.feature_lr / 20 if self.lr_sh_rest is None else self.lr_sh_rest
            knobs["lr_sh_rest"] = rest
        if self.test_iterations is not None:
            knobs["test_iterations"] = tuple(step for step in self.test_iterations if step > 0)
        return {name: value for name, value in knobs.items() if value is not None}

    def _config(self) -> TrainConfig:
        from snowsplat.training.recipes import recipe

        return recipe(self.recipe or "default", **self._knobs())

    def _checkpoint(self, out: OutputFolder) -> Checkpoint | None:
        from snowsplat.training import checkpoint

        newest = checkpoint.latest(out.checkpoints)
        if newest is not None:
            return newest
        if self._dataset_path() is None:
            raise UserError(
                f"{out.path}: holds no whole checkpoint to resume; name the dataset to begin anew"
            )
        if out.scenes() or checkpoint.exists(out.checkpoints):
            what = "a scene" if out.scenes() else "checkpoints"
            raise UserError(
                f"{out.path}: holds {what} but no whole checkpoint to resume; add --overwrite "
                "instead of --resume to begin anew"
            )
        self._say(f"{out.path}: no checkpoint yet; beginning at step 0")
        return None

    def _resumed_config(self, start: Checkpoint, noted: Noted) -> TrainConfig:
        """The checkpoint's own; flags may change only what leaves the steps so far as they were."""
        from snowsplat.training.config import changed, config_from_json

        config = config_from_json(noted.training)
        if self.recipe not in (None, noted.recipe):
            raise UserError(f"{start.path}: is of the recipe {noted.recipe}; leave out --recipe")
        resumed = changed(config, **self._knobs())
        same = replace(resumed, **{name: getattr(config, name) for name in _FREE_ON_RESUME})
        if same != config:
            raise _other_settings(start)
        # A training with a time may have gone beyond what was planned at first.
        if self.iterations is not None and resumed.iterations < start.step:
            raise UserError(
                f"{start.path}: is of step {start.step}, beyond --iterations {resumed.iterations}; "
                "name more"
            )
        return resumed

    # Words

    def _describe(self, dataset: Dataset, trainer: Trainer, start: Checkpoint | None) -> None:
        camera = dataset.train[0].camera
        points = "no points" if dataset.points is None else f"{len(dataset.points):,} points"
        self._say(
            f"{dataset.description}: {len(dataset.train)} photos to train on, {len(dataset.test)} "
            f"held out, {camera.width}x{camera.height}, {points}"
        )
        if start is not None:
            self._say(
                f"going on from {start.path}, step {start.step} of {trainer.schedule.iterations}"
            )

    def _say(self, line: str) -> None:
        if not self.quiet:
            print(line, flush=True)
