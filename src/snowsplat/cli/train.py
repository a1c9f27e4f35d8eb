"""`snowsplat train`: trains a scene from photos with known camera poses."""

from __future__ import annotations

import sys
from contextlib import nullcontext, suppress
from dataclasses import dataclass

from snowsplat.cli.flags import with_flags
from snowsplat.cli.next_steps import next_step, see_and_share
from snowsplat.cli.observer import TerminalObserver
from snowsplat.cli.page_flags import page_at
from snowsplat.cli.reports import JsonFlag, Reports
from snowsplat.cli.train_flags import TrainFlags
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.util.run_lock import one_run


@dataclass
class Train(TrainFlags, Reports):
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

    json: JsonFlag = False

    def run(self) -> int:
        """Returns the exit code: 0, or 130 after Ctrl-C (with the scene and a checkpoint saved)."""
        if self.output is None:
            raise UserError("train needs a folder for the result; add -o OUT")
        from snowsplat.pipeline.run import processes
        from snowsplat.pipeline.run.train_result import TrainingStopped
        from snowsplat.project.training_folder import TrainingFolder

        if self.processes is not None and self.processes != 1 and processes.count() == 1:
            return processes.launch(self.processes, sys.argv[1:])
        processes.end_with_launcher()
        if not processes.is_first():
            from snowsplat.pipeline.train import follow_training

            follow_training(self.options().compute)
            return 0
        if self.resume and self.overwrite:
            raise UserError("--resume and --overwrite cannot be combined; use one of them")
        dataset, options = self.dataset_path(), self.options()
        with one_run(self.output):  # reports what is wrong before torch is imported
            TrainingFolder(self.output).check_free(resume=self.resume, overwrite=self.overwrite)
        if dataset is None and not self.resume:
            raise UserError("train needs a dataset; add the folder of the photos and their cameras")
        from snowsplat.pipeline.observer import Observers
        from snowsplat.pipeline.step_logs import LOGS
        from snowsplat.pipeline.train import resume, train

        logs = [LOGS[name](TrainingFolder(self.output)) for name in self.log]
        page = page_at(self.port, self.host, self.allow_host, self.view)
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
                print(with_flags(str(stopped)))
                if stopped.scene is None:
                    raise
                print(next_step("resume with", "train", "-o", self.output, "--resume"))
                return 130
            step, metrics = result.evaluation or (None, None)
            measured = None if metrics is None else {"step": step, **metrics.as_json()}
            self.report = {**vars(result), "evaluation": measured}
            if result.verdict is not None:
                print("\n".join(result.verdict.lines(message("the scene"))), flush=True)
            if not self.quiet:
                print(see_and_share(self.output), flush=True)
            if page is not None:
                with suppress(KeyboardInterrupt):  # Ctrl-C may arrive during the print
                    print(
                        message("the scene is shown at {url} until Ctrl-C", url=page.url),
                        flush=True,
                    )
                    page.show_result()
        return 0
