"""`merge_blocks`: joins the scenes of the blocks. It needs the memory of one block."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from snowsplat.formats import GaussianArrays
from snowsplat.formats.ply import read_ply, write_ply_parts
from snowsplat.pipeline.blocks.cells import Axes, Cell
from snowsplat.pipeline.blocks.plan import Plan
from snowsplat.pipeline.blocks.train import is_finished, scene_folder
from snowsplat.project.training_folder import TrainingFolder
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.util.errors import UserError
from snowsplat.util.files import atomic_path

# Large Gaussians on both sides of a border, such as those of the sky, need not be at the same place
# in both blocks. Without those that reach across it, there are gaps.
_REACH = 2.0


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


def _deviations(gaussians: Gaussians, axes: Axes) -> Tensor:
    """(N, 2) standard deviations along the axes of the ground plane."""
    rotations = rotation_from_quat(gaussians.quats)  # its columns are the axes of the Gaussian
    along = torch.tensor(axes, dtype=rotations.dtype) @ rotations
    return (along * gaussians.log_scales.exp()[:, None]).norm(dim=2).double()


def _own(plan: Plan, cell: Cell, file: Path) -> Callable[[], tuple[int, GaussianArrays]]:
    """Reads a block: its number of Gaussians, and the Gaussians in its cell."""

    def read() -> tuple[int, GaussianArrays]:
        arrays = read_ply(file).seen_from(plan.origin)
        gaussians = arrays.to_gaussians()
        reach = _REACH * _deviations(gaussians, plan.axes)
        own = cell.contains(plan.ground(gaussians.means), reach)
        return len(gaussians), arrays.select(own.numpy())

    return read
