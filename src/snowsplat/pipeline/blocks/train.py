"""`train_blocks`: trains the blocks that are not finished, on one or several computers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from snowsplat.pipeline.blocks.plan import Block, Plan
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.run.train_result import TrainResult
from snowsplat.pipeline.train import resume, train
from snowsplat.project.training_folder import DATASET, SCENE, TrainingFolder
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.messages import Message, message
from snowsplat.util.run_lock import InUse, one_run

_CHECKPOINT_SECONDS = 60.0


def scene_folder(folder: Path, block: Block) -> TrainingFolder:
    """The output folder of the training of a block."""
    return TrainingFolder(folder / block.name / SCENE)


def is_finished(out: TrainingFolder) -> bool:
    """Whether a training run in an output folder has reached its last step.

    Raises: UserError: its settings are damaged.
    """
    scenes = out.scenes()
    if not scenes:
        return False
    iterations = out.training_settings().get("iterations")
    if not isinstance(iterations, int):
        raise UserError("{path}: its settings are damaged; remove it", path=out.path)
    return scenes[-1] >= iterations


def train_blocks(
    folder: Path | str,
    only: Sequence[int] = (),
    *,
    compute: Compute | None = None,
    memory: int | str | None = None,
    observer: Observer = SILENT,
    on_block: Callable[[Message], None] = lambda line: None,
) -> list[TrainResult]:
    """Train the blocks of a plan, in this order, except those that are finished.

    A block whose training was interrupted continues from its last checkpoint. Several computers may
    call this at the same time with the same folder: each trains blocks that no other one trains.

    Args:
        only: numbers of blocks, from 1; empty: all.
        memory: limit for each block, see `TrainOptions`.
        on_block: receives a line about each block.

    Returns:
        The results of the blocks that were trained now.

    Raises:
        UserError: there is no plan or no such block, or other processes train all the blocks that
            are not finished; see also `snowsplat.pipeline.train.train`.
        TrainingStopped: Ctrl-C. A checkpoint is saved, and the same call continues.
        KeyboardInterrupt: Ctrl-C before the first step of a block.
    """
    folder = Path(folder)
    plan = Plan.read(folder)
    for number in only:
        if not 1 <= number <= len(plan.blocks):
            raise SettingError(
                "block",
                "{number} does not exist; use 1 to {blocks}",
                number=number,
                blocks=len(plan.blocks),
            )
    results, elsewhere = [], list[InUse]()
    for number, block in enumerate(plan.blocks, 1):
        if only and number not in only:
            continue
        out = scene_folder(folder, block)
        if is_finished(out):
            on_block(message("{name}: finished", name=block.name))
            continue
        try:
            with one_run(folder / block.name):
                if not is_finished(out):  # by another process, a moment ago
                    on_block(
                        message(
                            "{name}: {views} photos, {points:,} points",
                            name=block.name,
                            views=block.views,
                            points=block.points,
                        )
                    )
                    compute = compute or Compute()
                    results.append(_train(folder, plan, block, compute, memory, observer))
        except InUse as error:
            elsewhere.append(error)
            on_block(error.message)
    if elsewhere and not results:
        raise elsewhere[0]
    return results


def _train(
    folder: Path,
    plan: Plan,
    block: Block,
    compute: Compute,
    memory: int | str | None,
    observer: Observer,
) -> TrainResult:
    dataset, out = folder / block.name / DATASET, scene_folder(folder, block)
    options = TrainOptions(
        recipe=plan.recipe,
        settings={**plan.settings, "max_gaussians": block.max_gaussians},
        resolution=plan.dataset.resolution,
        memory=memory,
        trust_cameras=True,  # `plan_blocks` has checked the whole dataset
        checkpoint_seconds=_CHECKPOINT_SECONDS,
        compute=compute,
    )
    if out.is_training():
        return resume(out.path, options, dataset=dataset, observer=observer)
    return train(dataset, out.path, options, observer=observer)
