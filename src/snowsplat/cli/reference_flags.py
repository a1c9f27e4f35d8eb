"""The flags of the reference implementation's command lines: one table of what each becomes here.

A script that was written for `train.py`, `render.py`, `metrics.py` or `convert.py` runs with the
corresponding subcommand. A flag is a flag of the subcommand, too; or it is replaced; or it has no
effect here, which is said in a line; or it is refused, with what to use instead. The guide "Coming
from the reference implementation" shows this table.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import from_json, read_json


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


@cache
def programs() -> dict[str, tuple[str, tuple[ReferenceFlag, ...]]]:
    """The name of the subcommand -> its program in the reference implementation, and the flags, as
    in `reference_flags.json`; some of them are shared."""
    table = read_json(Path(__file__).with_suffix(".json"))
    return {
        subcommand: (
            each["program"],
            tuple(
                from_json(ReferenceFlag, flag)
                for flag in [*(table["shared"] if each.get("shares") else ()), *each["flags"]]
            ),
        )
        for subcommand, each in table["programs"].items()
    }


def translated(subcommand: str, arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """The arguments for a subcommand without the flags that it does not have, and notes on these.

    Raises: UserError: a flag is refused; the message names what to use instead.
    """
    _, flags = programs().get(subcommand, ("", ()))
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
