"""The flags of the reference implementation's command lines: one table of what each becomes here.

A script that was written for `train.py`, `render.py`, `metrics.py` or `convert.py` runs with the
corresponding subcommand. A flag is a flag of the subcommand, too; or it is replaced; or it has no
effect here, which is said in a line; or it is refused, with what to use instead. The guide "Coming
from the reference implementation" shows this table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from snowsplat.util.errors import UserError


@dataclass(frozen=True)
class ReferenceFlag:
    """A flag of the reference implementation."""

    spellings: tuple[str, ...]  # as in its command line, with "_"; here "-" is accepted, too
    # own: the subcommand has this flag; becomes: it is replaced by ``new``; ignored: it has no
    # effect here, and the note is printed; refused: the note is the error.
    outcome: Literal["own", "becomes", "ignored", "refused"]
    note: str = ""  # why, and what to use instead; or a remark for the guide: how it differs
    new: tuple[str, ...] = ()  # the flags in its place, before its values
    values: int | Literal["+"] = 0  # number of its values; "+": all up to the next flag
    only_with: str | None = None  # it is ignored, with the note, without this flag


def _own(spellings: str, note: str = "") -> ReferenceFlag:
    return ReferenceFlag(tuple(spellings.split()), "own", note)


def _becomes(
    spellings: str, new: str, note: str = "", values: int | Literal["+"] = 0, with_: str = ""
) -> ReferenceFlag:
    return ReferenceFlag(
        tuple(spellings.split()), "becomes", note, tuple(new.split()), values, with_ or None
    )


def _ignored(spellings: str, note: str, values: int = 0) -> ReferenceFlag:
    return ReferenceFlag(tuple(spellings.split()), "ignored", note, (), values)


def _refused(spellings: str, note: str, values: int | Literal["+"] = 1) -> ReferenceFlag:
    return ReferenceFlag(tuple(spellings.split()), "refused", note, (), values)


_PAGE = "there is a page only with --view; snowsplat watch OUT shows a running training"
_DEPTH = "--depth-weight compares the depth with the depth maps in DATASET/depths"
_ONE_CAUSE = "a kernel that fails ends the run with its message"

# The flags that train.py and render.py share.
_SHARED = (
    _own("--source_path -s"),
    _own("--model_path -m"),
    _own("--resolution -r", "-1 reduces no photo, however wide it is"),
    _ignored("--data_device", "photos stay decoded as far as memory suffices, see --memory", 1),
    _ignored("--convert_SHs_python", "it chooses another way to the same image"),
    _ignored("--compute_cov3D_python", "it chooses another way to the same image"),
    _ignored("--debug", _ONE_CAUSE),
    _becomes("--antialiasing", "--antialias on", "its filter is 0.1 pixels², not 0.3"),
)

#: The name of the subcommand -> its program in the reference implementation, and the flags.
PROGRAMS: dict[str, tuple[str, tuple[ReferenceFlag, ...]]] = {
    "train": (
        "train.py",
        (
            *_SHARED,
            *map(_own, ("--images -i", "--eval", "--white_background -w")),
            _becomes("--random_background", "--background random"),
            *map(_own, ("--sh_degree", "--iterations", "--test_iterations", "--save_iterations")),
            *map(_own, ("--quiet", "--feature_lr", "--opacity_lr", "--scaling_lr")),
            *map(_own, ("--rotation_lr", "--position_lr_init", "--position_lr_final")),
            _own("--position_lr_max_steps"),
            _ignored(
                "--position_lr_delay_mult",
                "its delay has 0 steps, in the reference implementation, too",
                1,
            ),
            *map(_own, ("--lambda_dssim", "--percent_dense", "--densification_interval")),
            *map(_own, ("--densify_from_iter", "--densify_until_iter")),
            *map(_own, ("--densify_grad_threshold", "--opacity_reset_interval")),
            _ignored("--optimizer_type", "the recipe chooses the optimiser", 1),
            _refused(
                "--checkpoint_iterations",
                "use --checkpoint-every N, which saves a checkpoint every N steps",
                "+",
            ),
            _refused(
                "--start_checkpoint",
                "use --resume, which continues from the newest checkpoint in OUT",
            ),
            _refused(
                "--train_test_exp",
                "use --exposure on, which learns a gain for each photo and colour channel",
                0,
            ),
            _ignored(
                "--exposure_lr_init --exposure_lr_final --exposure_lr_delay_steps "
                "--exposure_lr_delay_mult",
                "the gains of --exposure have a learning rate of their own",
                1,
            ),
            _refused(
                "--depths -d",
                f"use --init depth+points, which starts with the depth maps; {_DEPTH}",
            ),
            _ignored("--depth_l1_weight_init --depth_l1_weight_final", _DEPTH, 1),
            _becomes("--ip", "--host", _PAGE, 1, "--view"),
            _becomes("--port", "--port", _PAGE, 1, "--view"),
            _ignored("--disable_viewer", _PAGE),
            _ignored("--debug_from", _ONE_CAUSE, 1),
            _ignored("--detect_anomaly", "values that are not finite always end the training"),
        ),
    ),
    "render": (
        "render.py",
        (
            *_SHARED,
            *map(_own, ("--iteration", "--skip_train", "--skip_test")),
            _becomes("--quiet", "", "no progress is printed"),
            _ignored(
                "--images -i", "the photos are those of the training; -r changes their size", 1
            ),
            _ignored("--eval", "the photos are held out as in the training"),
            _ignored("--white_background -w", "the background is that of the training"),
            _ignored("--sh_degree", "that of the scene is used", 1),
            _ignored("--depths -d", "the depth maps are for the training", 1),
            _ignored("--train_test_exp", "images have the mean exposure of the photos"),
        ),
    ),
    "evaluate": ("metrics.py", (_becomes("--model_paths -m", "--model-paths", values="+"),)),
    "sfm": (
        "convert.py",
        (
            *map(_own, ("--source_path -s", "--camera", "--skip_matching", "--resize")),
            _ignored("--no_gpu", "photos are matched on the CPU in any case"),
            _ignored("--colmap_executable", "COLMAP is part of the installation", 1),
            _ignored("--magick_executable", "ImageMagick is not needed", 1),
        ),
    ),
}


def translated(subcommand: str, arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The arguments for a subcommand without the flags that it does not have, and notes on these.

    Raises: UserError: a flag is refused; the message names what to use instead.
    """
    _, flags = PROGRAMS.get(subcommand, ("", ()))
    known = {s.replace("_", "-"): flag for flag in flags for s in flag.spellings}
    result: list[str] = []
    notes: list[str] = []
    rest = list(arguments)
    while rest:
        argument = rest.pop(0)
        name, given, value = argument.partition("=")
        flag = known.get(name.replace("_", "-"))
        if flag is None or flag.outcome == "own":
            result.append(argument)
            continue
        if flag.outcome == "refused":
            raise UserError("{name}: {note}", name=name, note=flag.note)
        values = [value] if given else rest[: _count(flag, rest)]
        rest = rest if given else rest[len(values) :]
        if flag.outcome == "ignored" or (flag.only_with and flag.only_with not in arguments):
            notes.append(f"{name} has no effect: {flag.note}")
        else:
            result += [*flag.new, *values]
    return result, notes


def _count(flag: ReferenceFlag, rest: Sequence[str]) -> int:
    """How many of the following arguments are values of the flag."""
    if flag.values != "+":
        return flag.values
    return next((i for i, text in enumerate(rest) if text.startswith("-")), len(rest))
