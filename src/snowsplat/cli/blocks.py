"""`snowsplat blocks`: a scene that is larger than the memory, in blocks that are merged."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from snowsplat.cli.config_flags import RECIPE, RECIPE_FLAG, RecipeName
from snowsplat.cli.flags import flag, switch
from snowsplat.cli.next_steps import next_step, see_and_share
from snowsplat.cli.observer import TerminalObserver
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message

# The flags of each action; the others have no effect and are rejected.
_FLAGS = {
    "plan": (
        "output",
        "blocks",
        "margin",
        "recipe",
        "iterations",
        "max_gaussians",
        "images",
        "resolution",
        "eval",
        "test_list",
    ),
    "train": ("block", "memory", "device", "threads", "quiet"),
    "merge": ("output",),
}


@dataclass
class Blocks:
    """Train a scene that is larger than the memory, in blocks that are merged.

    Examples:
      snowsplat blocks plan city -o out --blocks 6 --eval   cut it into six blocks
      snowsplat blocks train out                            train all blocks
      snowsplat blocks train out --block 3                  only the third one
      snowsplat blocks merge out                            join them
      snowsplat evaluate out                                PSNR and SSIM
      snowsplat view out

    Notes:
      The ground plane is cut into cells with about equal numbers of cameras and
      points. OUT/block_01/dataset and so on are ordinary datasets, with links to
      the photos. blocks train trains those that are not finished; after Ctrl-C
      or a crash, the same command continues. Several computers with a shared
      folder can run it at the same time: each trains blocks that no other one
      trains.
    """

    action: Annotated[
        Literal["plan", "train", "merge"] | None, tyro.conf.Positional, flag("{plan,train,merge}")
    ] = None
    """plan: cut a dataset into blocks; train: train blocks; merge: join their scenes."""
    path: Annotated[Path | None, tyro.conf.Positional, flag("DATASET|OUT")] = None
    """plan: the dataset; train, merge: the folder of the plan."""

    output: Annotated[Path | None, flag("OUT|FILE", "-o")] = None
    """plan: a new folder for the plan, the blocks and the merged scene. merge: a PLY file that also
    gets the merged scene."""
    blocks: Annotated[int | None, flag("N", default="4")] = None
    """plan: number of blocks."""
    margin: Annotated[float | None, flag("F", default="0.2")] = None
    """plan: a block is trained with the photos and points of its cell, expanded on each side by
    this share of its size."""
    recipe: Annotated[RecipeName | None, RECIPE_FLAG] = None
    """plan: the recipe of the training, see snowsplat train."""
    iterations: Annotated[int | None, flag("N", default=RECIPE)] = None
    """plan: number of training steps of each block."""
    max_gaussians: Annotated[int | None, flag("N", default=RECIPE)] = None
    """plan: maximum number of Gaussians of the whole scene, which the blocks share; 0: no limit."""
    images: Annotated[str | None, flag("NAME", "-i", default="images")] = None
    """plan: name of the folder with the photos, in the folder of the dataset."""
    resolution: Annotated[int | None, flag("N", "-r", default="unchanged")] = None
    """plan: with 1, 2, 4 or 8, the width and height of the photos are divided by this number. Any
    other number is the new width in pixels."""
    eval: Annotated[bool, switch()] = False
    """plan: hold out every 8th photo of the whole (or the test split of the dataset). No block is
    trained with them, and snowsplat evaluate OUT uses them."""
    test_list: Annotated[Path | None, flag("FILE")] = None
    """plan: text file with the names of the photos to hold out, one per line. Implies --eval."""

    block: Annotated[tuple[int, ...], flag("[N ...]", default="all")] = ()
    """train: numbers of the blocks to train, from 1."""
    memory: Annotated[str | None, flag("BYTES", default="no limit")] = None
    """train: memory limit of the training, see snowsplat train."""
    device: Annotated[str | None, flag("{cuda,cuda:N,cpu}", default="a GPU if there is one")] = None
    """train: device to train on."""
    threads: Annotated[int | None, flag("N", default="all cores")] = None
    """train: number of CPU threads. The result does not depend on this number."""
    quiet: Annotated[bool, switch("-q")] = False
    """train: print only the results and no progress."""

    def run(self) -> int:
        """Returns the exit code: 0, or 130 after Ctrl-C, with a checkpoint saved."""
        if self.action is None:
            raise UserError("blocks needs an action: plan, train or merge")
        self._check_flags(self.action)
        if self.path is None:
            what = "a dataset" if self.action == "plan" else "the folder of a plan"
            raise UserError("blocks {action} needs {what}", action=self.action, what=what)
        if self.action == "plan":
            return self._plan(self.path)
        return self._train(self.path) if self.action == "train" else self._merge(self.path)

    def _check_flags(self, action: str) -> None:
        """Raise `UserError` if a flag of another action is given."""
        for field in fields(self)[2:]:
            if field.name not in _FLAGS[action] and getattr(self, field.name) != field.default:
                owner = next(name for name, names in _FLAGS.items() if field.name in names)
                raise UserError(
                    "`{name}` belongs to blocks {owner}, not to blocks {action}",
                    name=field.name,
                    owner=owner,
                    action=action,
                )

    def _plan(self, dataset: Path) -> int:
        if self.output is None:
            raise UserError("blocks plan needs a folder for the blocks; add -o OUT")
        from snowsplat.pipeline.blocks.plan import PlanOptions, plan_blocks

        settings = {"iterations": self.iterations, "max_gaussians": self.max_gaussians}
        given: dict[str, Any] = {
            "blocks": self.blocks,
            "margin": self.margin,
            "recipe": self.recipe,
            "settings": {name: n for name, n in settings.items() if n is not None},
            "images": self.images,
            "resolution": self.resolution,
            "hold_out": 8 if self.eval else None,
            "test_list": self.test_list,
        }
        options = PlanOptions(**{name: v for name, v in given.items() if v is not None})
        plan = plan_blocks(dataset, self.output, options)
        for block in plan.blocks:
            limit = f"{block.max_gaussians:,}" if block.max_gaussians else "no limit"
            print(
                message(
                    "{name}: {views} photos, {points:,} points, at most {limit} Gaussians",
                    name=self.output / block.name,
                    views=block.views,
                    points=block.points,
                    limit=limit,
                )
            )
        if distance := plan.settings.get("sky_distance"):
            print(message("distance of the sky in all of them: {distance:g}", distance=distance))
        print(next_step("train them with", "blocks", "train", self.output))
        return 0

    def _train(self, folder: Path) -> int:
        from snowsplat.pipeline.blocks.train import train_blocks
        from snowsplat.pipeline.compute import Compute
        from snowsplat.pipeline.run.train_result import TrainingStopped

        with TerminalObserver(self.quiet) as observer:
            try:
                train_blocks(
                    folder,
                    self.block,
                    compute=Compute(self.device, self.threads),
                    memory=self.memory,
                    observer=observer,
                    on_block=lambda line: print(line, flush=True),
                )
            except TrainingStopped as stopped:
                print(message("{stopped}; continue with the same command", stopped=stopped))
                return 130
        print(next_step("when all blocks are trained", "blocks", "merge", folder))
        return 0

    def _merge(self, folder: Path) -> int:
        from snowsplat.pipeline.blocks.merge import merge_blocks

        merged = merge_blocks(folder, self.output)
        kept, trained = sum(merged.gaussians), sum(merged.trained)
        print(
            message(
                "{scene}: {kept:,} Gaussians of {gaussians} blocks",
                scene=merged.scene,
                kept=kept,
                gaussians=len(merged.gaussians),
            )
        )
        print(
            message(
                "{kept:,} Gaussians outside of the cells of their blocks are left out",
                kept=trained - kept,
            )
        )
        print(see_and_share(folder))
        return 0
