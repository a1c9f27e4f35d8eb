"""`snowsplat blocks`: a scene that is larger than the memory, in blocks that are merged."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from snowsplat.cli.command import Command, Exit, next_step, print_message, see_and_share
from snowsplat.cli.observer import TerminalObserver
from snowsplat.pipeline.compute import Compute
from snowsplat.pipeline.options import common
from snowsplat.pipeline.options.benchmark import PlanOptions
from snowsplat.util.errors import UserError
from snowsplat.util.flags import flags_of
from snowsplat.util.messages import message
from snowsplat.util.settings import Settings, argument, group, setting

# The fields with flags of each action; those of other actions have no effect and are rejected.
_FIELDS = {"plan": ("output", "planned"), "train": ("training",), "merge": ("output",)}


@dataclass(frozen=True)
class BlockTraining(Settings):
    """Which blocks are trained, and how."""

    block: tuple[int, ...] = setting(
        (), "Numbers of the blocks to train, from 1.", "all", metavar="[N ...]"
    )
    memory: int | str | None = common.memory()
    compute: Compute = group(Compute, only=("device", "threads"))
    quiet: bool = common.quiet()


@dataclass(frozen=True, kw_only=True)
class Blocks(Command):
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

    action: Literal["plan", "train", "merge"] | None = argument(
        None,
        "{plan,train,merge}",
        "plan: cut a dataset into blocks; train: train blocks; merge: join their scenes.",
    )
    path: Path | None = argument(
        None, "DATASET|OUT", "plan: the dataset; train, merge: the folder of the plan."
    )
    output: Path | None = setting(
        None,
        "plan: a new folder for the plan, the blocks and the merged scene. merge: a PLY file that "
        "also gets the merged scene.",
        metavar="OUT|FILE",
        aliases=("-o",),
    )
    planned: PlanOptions = group(PlanOptions, action="plan")
    training: BlockTraining = group(BlockTraining, action="train")

    def run(self) -> Exit | None:
        """The exit code is 130 after Ctrl-C, with a checkpoint saved."""
        if self.action is None:
            raise UserError("blocks needs an action: plan, train or merge")
        for flag in flags_of(Blocks):
            owners = [action for action, fields in _FIELDS.items() if flag.path[0] in fields]
            if flag.key in self.given and owners and self.action not in owners:
                raise UserError(
                    "{flag} belongs to blocks {owner}, not to blocks {action}",
                    flag=flag.spellings[0],
                    owner=owners[0],
                    action=self.action,
                )
        if self.path is None:
            if self.action == "plan":
                raise UserError("blocks plan needs a dataset")
            raise UserError("blocks {action} needs the folder of a plan", action=self.action)
        actions = {"plan": self._plan, "train": self._train, "merge": self._merge}
        return actions[self.action](self.path)

    def _plan(self, dataset: Path) -> Exit | None:
        if self.output is None:
            raise UserError("blocks plan needs a folder for the blocks; add -o OUT")
        from snowsplat.pipeline.blocks.plan import plan_blocks

        plan = plan_blocks(dataset, self.output, self.planned)
        for block in plan.blocks:
            limit = f"{block.max_gaussians:,}" if block.max_gaussians else message("no limit")
            print_message(
                "{name}: {views} photos, {points:,} points, at most {limit} Gaussians",
                name=self.output / block.name,
                views=block.views,
                points=block.points,
                limit=limit,
            )
        if distance := plan.settings.get("sky_distance"):
            print_message("distance of the sky in all of them: {distance:g}", distance=distance)
        print(next_step(message("train them with"), "blocks", "train", self.output))
        return None

    def _train(self, folder: Path) -> Exit | None:
        from snowsplat.pipeline.blocks.train import train_blocks
        from snowsplat.pipeline.run.results import TrainingStopped

        with TerminalObserver(self.training.quiet) as observer:
            try:
                train_blocks(
                    folder,
                    self.training.block,
                    compute=self.training.compute,
                    memory=self.training.memory,
                    observer=observer,
                    on_block=print_message,
                )
            except TrainingStopped as stopped:
                print_message("{stopped}; continue with the same command", stopped=stopped)
                return Exit(130)
        print(next_step(message("when all blocks are trained"), "blocks", "merge", folder))
        return None

    def _merge(self, folder: Path) -> Exit | None:
        from snowsplat.pipeline.blocks.train import merge_blocks

        merged = merge_blocks(folder, self.output)
        kept, trained = sum(merged.gaussians), sum(merged.trained)
        print_message(
            "{scene}: {kept:,} Gaussians of {gaussians} blocks",
            scene=merged.scene,
            kept=kept,
            gaussians=len(merged.gaussians),
        )
        print_message(
            "{kept:,} Gaussians outside of the cells of their blocks are left out",
            kept=trained - kept,
        )
        print(see_and_share(folder))
        return None
