"""`snowsplat train`: trains a scene from photos with known camera poses."""

from __future__ import annotations

import sys
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from snowsplat.cli.command import Exit, JsonCommand, next_step, print_message, see_and_share
from snowsplat.cli.config_file import config, training_in
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.pages import PageAddress
from snowsplat.pipeline.options import common
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.util.errors import UserError
from snowsplat.util.flags import with_flags
from snowsplat.util.messages import message
from snowsplat.util.run_lock import one_run
from snowsplat.util.settings import argument, flag, group, needed, setting, switch

if TYPE_CHECKING:
    from snowsplat.project.training_folder import DatasetSettings
    from snowsplat.training.settings.config import TrainConfig


@dataclass(frozen=True, kw_only=True)
class Train(JsonCommand):
    """Train a scene from photos with known camera poses (COLMAP or transforms.json).

    Examples:
      snowsplat train garden -o out                  2000 steps; takes a few minutes
      snowsplat train garden -o out --eval           hold out every 8th photo
      snowsplat train garden -o out -r 4             faster: 1/4 of the width
      snowsplat train garden -o out --minutes 5      finish within 5 minutes
      snowsplat train garden -o out --recipe paper   the 30,000 steps of the paper
      snowsplat train garden -o out --checkpoint-every 1000
      snowsplat train -o out --resume                continue from a checkpoint
      snowsplat train garden -o out --batch 4 --processes 4
      torchrun --nproc-per-node 4 -m snowsplat train garden -o out --batch 4

    Notes:
      The scene is written to OUT/point_cloud/iteration_N/point_cloud.ply.
      Ctrl-C stops the training and saves the current scene and a checkpoint.
      The flags of the reference implementation are accepted (-s -m -i -r -w …).
    """

    dataset: Path | None = argument(
        None,
        "DATASET",
        "Folder with photos and their cameras: images/ and a COLMAP model in sparse/0/, or "
        "transforms.json.",
    )
    output: Path = needed(
        "train needs a folder for the result; add -o OUT",
        "OUT",
        "Output folder. It is created if it does not exist.",
        "-o",
        "-m",
        "--model-path",
    )
    source_path: Path | None = setting(
        None,
        "The same as DATASET. This is the flag of the reference implementation.",
        metavar="DATASET",
        aliases=("-s",),
    )
    config: Path | None = config(
        ', such as {"iterations": 3000, "eval": true}, or the config.json of an earlier training, '
        "whose settings are used"
    )
    options: TrainOptions = group(TrainOptions)
    white_background: bool = switch("The same as --background white.", "-w")
    feature_lr: float | None = flag(
        None,
        "Set --lr-sh-dc to F and --lr-sh-rest to F/20, as in the reference implementation.",
        "set by the recipe",
    )
    view: bool = switch(
        "Show the training in the browser: the scene, curves of loss and PSNR, and a button to "
        "pause. After the training, the page stays open until Ctrl-C."
    )
    address: PageAddress = group(PageAddress)
    resume: bool = switch(
        "Continue from the newest checkpoint in OUT. The result is the same as without the "
        "interruption."
    )
    overwrite: bool = common.overwrite("Replace the results of an earlier training run in OUT.")
    processes: int | None = flag(
        None,
        "Distribute the Gaussians over N processes on this computer, which needs less memory per "
        "process. Use it with --batch of N or a multiple of N. With --deterministic or on a CPU, "
        "the result is the same as that of one process.",
        "1",
    )
    log: tuple[Literal["csv", "tensorboard"], ...] = flag(
        (),
        "Also write loss, number of Gaussians and metrics of the steps: csv: to OUT/log.csv; "
        "tensorboard: to OUT/tensorboard, which needs the package snowsplat[tensorboard].",
        "none",
    )
    quiet: bool = common.quiet()

    def run(self) -> Any:
        """The exit code is 130 after Ctrl-C, with the scene and a checkpoint saved."""
        from snowsplat.pipeline.run import processes
        from snowsplat.pipeline.run.results import TrainingStopped
        from snowsplat.project.training_folder import TrainingFolder

        if self.processes is not None and self.processes != 1 and processes.count() == 1:
            return Exit(processes.launch(self.processes, sys.argv[1:]))
        processes.end_with_launcher()
        if not processes.is_first():
            from snowsplat.pipeline.train import follow_training

            follow_training(self.options.compute)
            return None
        if self.resume and self.overwrite:
            raise UserError("--resume and --overwrite cannot be combined; use one of them")
        dataset, options = self._dataset(), self._options()
        with one_run(self.output):  # reports what is wrong before torch is imported
            TrainingFolder(self.output).check_free(resume=self.resume, overwrite=self.overwrite)
        if dataset is None and not self.resume:
            raise UserError("train needs a dataset; add the folder of the photos and their cameras")
        from snowsplat.pipeline.observer import LOGS, Observers
        from snowsplat.pipeline.train import resume, train

        logs = [LOGS[name](TrainingFolder(self.output)) for name in self.log]
        page = self.address.page(self.view)
        with TerminalObserver(self.quiet) as terminal, page or nullcontext():
            observer = Observers(terminal, *logs)
            try:
                if self.resume:
                    result = resume(
                        self.output, options, dataset=dataset, observer=observer, page=page
                    )
                else:
                    assert dataset is not None
                    result = train(
                        dataset,
                        self.output,
                        options,
                        overwrite=self.overwrite,
                        observer=observer,
                        page=page,
                    )
            except TrainingStopped as stopped:
                print(with_flags(str(stopped), Train))
                if stopped.scene is None:
                    raise
                print(next_step(message("resume with"), "train", "-o", self.output, "--resume"))
                return Exit(130)
            if result.verdict is not None:
                print("\n".join(result.verdict.lines(message("the scene"))), flush=True)
            if not self.quiet:
                print(see_and_share(self.output), flush=True)
            if page is not None:
                with suppress(KeyboardInterrupt):  # Ctrl-C may arrive during the print
                    print_message("the scene is shown at {url} until Ctrl-C", url=page.url)
                    page.show_result()
        step, metrics = result.evaluation or (None, None)
        measured = None if metrics is None else {"step": step, **metrics.as_json()}
        return {**vars(result), "evaluation": measured}

    def _dataset(self) -> Path | None:
        """The dataset, or None. Raises: UserError: it is named twice."""
        if self.dataset is not None and self.source_path is not None:
            raise UserError("the dataset is named twice; leave out DATASET or -s")
        given = self.dataset or self.source_path
        if given is None and self.config is not None and not self.resume:
            earlier = self._earlier[1].path
            given = Path(earlier) if earlier else None
        return given

    @cached_property
    def _earlier(self) -> tuple[TrainConfig, DatasetSettings]:
        """The configuration and the dataset of the earlier training that is the configuration."""
        assert self.config is not None
        return training_in(self.config)

    def _options(self) -> TrainOptions:
        """The options with what other flags set. Raises: UserError: contradictory flags."""
        given = self.options
        settings = dict(given.settings)
        if "test_iterations" in settings:  # -1: none
            wanted = settings["test_iterations"]
            settings["test_iterations"] = tuple(n for n in wanted if n > 0 or n < -1)
        if self.white_background and settings.setdefault("background", "white") != "white":
            raise UserError("-w and --background set different colours; use one of them")
        if self.feature_lr is not None:
            settings = {"lr_sh_dc": self.feature_lr, "lr_sh_rest": self.feature_lr / 20} | settings
        if self.config is None:
            return replace(given, settings=settings)
        config, dataset = self._earlier
        names = ["images", "resolution"]
        if given.hold_out is None and given.test_list is None:
            names += ["hold_out", "first_held_out", "test_list"]
        before = asdict(dataset)
        changes = {name: before[name] for name in names if getattr(given, name) is None}
        return replace(given, config=config, settings=settings, **changes)
