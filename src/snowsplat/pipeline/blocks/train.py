"""Trains the blocks that are not finished, on one or several computers, and joins their scenes.

Joining them needs the memory of one block.
"""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from snowsplat.formats import GaussianArrays
from snowsplat.formats.ply import read_ply, write_ply_parts
from snowsplat.pipeline.blocks.content import Cell
from snowsplat.pipeline.blocks.plan import Block, Plan
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.observer import SILENT, Observer
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.run.results import TrainResult
from snowsplat.pipeline.train import resume, train
from snowsplat.project.training_folder import DATASET, SCENE, TrainingFolder
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.files import atomic_path
from snowsplat.util.messages import Message, message
from snowsplat.util.run_lock import InUse, one_run

_CHECKPOINT_SECONDS = 60.0
# Large Gaussians on both sides of a border, such as those of the sky, need not be at the same place
# in both blocks. Without those that reach across it, there are gaps.
_REACH = 2.0


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


@dataclass(frozen=True)
class Merged:
    """A merged scene.

    Attributes:
        gaussians: their number of each block, without those outside of its cell.
        trained: their number of each block, with those.
    """

    scene: Path
    gaussians: tuple[int, ...]
    trained: tuple[int, ...]


def merge_blocks(folder: Path | str, output: Path | str | None = None) -> Merged:
    """Write the scene of all blocks to the output folder ``folder``.

    Of each block, it contains the Gaussians whose means are in the cell of the block, or closer to
    it than `_REACH` standard deviations. The blocks are read one after the other.

    Args:
        output: a PLY file that also gets the scene; it is replaced if it exists.

    Raises:
        UserError: no plan, or a block that is not trained; ``output`` is not a PLY file.
        OSError: a file cannot be written.
    """
    folder = Path(folder)
    plan = Plan.read(folder)
    if output is not None and Path(output).suffix.lower() != ".ply":
        raise UserError(
            "{output}: blocks are merged into a PLY file; use snowsplat convert {folder} "
            "{output} afterwards",
            output=output,
            folder=folder,
        )
    steps: set[int] = set()
    files = []
    for number, block in enumerate(plan.blocks, 1):
        out = scene_folder(folder, block)
        if not is_finished(out):
            raise UserError(
                "{name}: not trained; run snowsplat blocks train {folder} `block` {number}",
                name=block.name,
                folder=folder,
                number=number,
            )
        steps.add(out.scenes()[-1])
        files.append(out.scene_path(out.scenes()[-1]))
    parts = [_own(plan, block.cell, file) for block, file in zip(plan.blocks, files, strict=True)]
    counts, trained, rest, antialiased = [], [], 0, False
    for part in parts:
        all_of_block, own = part()
        counts.append(len(own.means))
        trained.append(all_of_block)
        rest = max(rest, own.sh_rest.shape[1])
        antialiased |= own.antialiased  # all blocks have the same settings
    if not sum(counts):
        raise UserError(
            "{folder}: no Gaussian is in the cell of its block; train more steps", folder=folder
        )
    scene = TrainingFolder(folder).scene_path(max(steps))
    scene.parent.mkdir(parents=True, exist_ok=True)
    own_rows = (part()[1] for part in parts)
    write_ply_parts(
        scene,
        sum(counts),
        rest,
        own_rows,
        antialiased=antialiased,
        origin=plan.origin,
        metres_per_unit=plan.metres_per_unit,
    )
    if output is not None:
        with atomic_path(output) as temporary:
            shutil.copyfile(scene, temporary)
    return Merged(scene, tuple(counts), tuple(trained))


def _own(plan: Plan, cell: Cell, file: Path) -> Callable[[], tuple[int, GaussianArrays]]:
    """Reads a block: its number of Gaussians, and the Gaussians in its cell."""

    def read() -> tuple[int, GaussianArrays]:
        arrays = read_ply(file).seen_from(plan.origin)
        gaussians = arrays.to_gaussians()
        rotations = rotation_from_quat(gaussians.quats)  # its columns are the axes of the Gaussian
        along = torch.tensor(plan.axes, dtype=rotations.dtype) @ rotations
        # Standard deviations along the axes of the ground plane.
        reach = _REACH * (along * gaussians.log_scales.exp()[:, None]).norm(dim=2).double()
        own = cell.contains(plan.ground(gaussians.means), reach)
        return len(gaussians), arrays.select(own.numpy())

    return read
