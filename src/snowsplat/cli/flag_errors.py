"""Invalid flags as one line: the flag, its value, and what is allowed.

tyro parses the flags. If it rejects them, the arguments are examined here: flags of other trainers
are translated, another unknown flag gets the most similar one as a suggestion, and an invalid value
is explained as it is in Python, with the declaration of the setting.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from functools import reduce
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from snowsplat.cli import other_trainers
from snowsplat.cli.command import Command
from snowsplat.cli.subcommands import SUBCOMMANDS
from snowsplat.training.settings.recipes import RECIPES
from snowsplat.util.flags import flags_of
from snowsplat.util.messages import Message, message
from snowsplat.util.safe_json import printable
from snowsplat.util.settings import allowed, kinds_of, shown, suggestion

_FLAG = re.compile(r"-[^\d.]")
_FRAME = "│|╭╮╰╯─┌┐└┘+-= "


def explained(command: type[Command], arguments: Sequence[str], printed: str) -> Message:
    """Why the arguments of a subcommand are invalid, on one line.

    ``printed``: what tyro has printed; it is used if the arguments do not show the reason.
    """
    flags, subcommand = spellings(command), command.__name__.lower()
    names = [each.partition("=")[0] for each in arguments if _FLAG.match(each)]
    unknown = {name: name.replace("_", "-") for name in names}
    advised = {
        name: other_trainers.advice(subcommand, spelling, flags)
        for name, spelling in unknown.items()
        if spelling not in flags
    }
    told = [
        message("{name}: {use}", name=printable(name), use=use)
        for name, use in advised.items()
        if use
    ]
    if told:
        return reduce(lambda one, other: message("{one}; {other}", one=one, other=other), told)
    for number, argument in enumerate(arguments):
        if not _FLAG.match(argument):
            continue
        name, given, value = argument.partition("=")
        spelling = name.replace("_", "-")
        if spelling not in flags:
            advice = suggestion(spelling, list(flags)) or message("leave it out")
            return message("{name}: unknown flag; {advice}", name=printable(name), advice=advice)
        hint, valid = flags[spelling]
        kinds = [each for each in kinds_of(hint) if each is not NoneType]
        if kinds == [bool]:
            continue
        texts = [value] if given else _values(arguments[number + 1 :])
        if get_origin(kinds[0]) is tuple:
            kinds = [get_args(kinds[0])[0]]
        elif not texts:
            return message("{flag}: needs a value; use {allowed}", flag=spelling, allowed=valid)
        else:
            texts = texts[:1]
        for text in texts:
            if not any(_is_of(text, each) for each in kinds):
                return message(
                    "{flag}: {value} is not valid; use {allowed}",
                    flag=spelling,
                    value=shown(text),
                    allowed=valid,
                )
    if extra := re.search(r"Unrecognized options: (.*)", printed):
        usage = SUBCOMMANDS[subcommand].usage
        extras = printable(extra[1].strip(_FRAME))
        what = message("{names}: too many names", names=extras)
        if recipe := next((each for each in arguments if each in RECIPES), None):
            what = message("{what}; use --recipe {recipe}", what=what, recipe=recipe)
        return Message(f"{what}; snowsplat {subcommand} {usage}")
    lines = [line.strip(_FRAME) for line in printed.splitlines()[1:]]
    end = lines.index("") if "" in lines else len(lines)
    of_parser = " ".join(lines[:end]).rstrip(".")
    return Message(of_parser) if of_parser else message("invalid flags")


def spellings(command: type[Command]) -> dict[str, tuple[Any, Message]]:
    """Each spelling of a flag of a subcommand -> the type of its value, and what is allowed."""
    known = dict.fromkeys(("-h", "--help"), (bool, Message("")))
    for flag in flags_of(command):
        # The declaration is that of the setting, the type that of the command line.
        declared = (flag.declared,) if flag.type == flag.hint or flag.declared.parse else ()
        known |= dict.fromkeys(flag.spellings, (flag.type, allowed(flag.type, *declared)))
    return known


def _values(arguments: Sequence[str]) -> list[str]:
    """The arguments before the next flag."""
    values = []
    for argument in arguments:
        if _FLAG.match(argument):
            break
        values.append(argument)
    return values


def _is_of(text: str, kind: Any) -> bool:
    """Whether a text is a value of the type ``kind``."""
    if get_origin(kind) is Literal:
        return text in get_args(kind)
    if kind in (int, float):
        with suppress(ValueError):
            kind(text)
            return True
        return False
    return True
