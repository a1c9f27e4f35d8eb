"""Invalid flags as one line: the flag, its value, and what is allowed.

tyro parses the flags. If it rejects them, the arguments are examined here: flags of other trainers
are translated, another unknown flag gets the most similar one as a suggestion, and an invalid value
is explained as it is in Python, with the declaration of the setting.

Flags and words of gsplat's `simple_trainer.py` and of nerfstudio are not accepted, because what
they do differs in detail: an error names what to use instead. Those of the reference implementation
are accepted, see `reference_flags`; only the name of its `convert.py` is that of another subcommand
here.
"""

import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from functools import reduce
from itertools import takewhile
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from snowsplat.cli.command import Command
from snowsplat.cli.subcommands import SUBCOMMANDS, load_subcommand
from snowsplat.training.settings.recipes import RECIPES
from snowsplat.util.flags import flags_of
from snowsplat.util.messages import Message, message
from snowsplat.util.safe_json import printable, read_json
from snowsplat.util.settings import allowed, kinds_of, shown, suggestion

_FLAG = re.compile(r"-[^\d.]")
_FRAME = "│|╭╮╰╯─┌┐└┘+-= "
# The flag to use -> flags of the others, without the group before a dot.
_FLAGS: dict[str, str] = read_json(Path(__file__).with_name("flags_of_others.json"))
_INPUTS = ["data", "data-dir", "ckpt", "load-config", "input"]


def explained(command: type[Command], arguments: Sequence[str], printed: str) -> Message:
    """Why the arguments of a subcommand are invalid, on one line.

    ``printed``: what tyro has printed; it is used if the arguments do not show the reason.
    """
    flags, subcommand = spellings(command), command.__name__.lower()
    names = [each.partition("=")[0] for each in arguments if _FLAG.match(each)]
    unknown = {name: name.replace("_", "-") for name in names}
    advised = {
        name: advice(subcommand, spelling, flags)
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
            hint = suggestion(spelling, list(flags)) or message("leave it out")
            return message("{name}: unknown flag; {advice}", name=printable(name), advice=hint)
        hint, valid = flags[spelling]
        kinds = [each for each in kinds_of(hint) if each is not NoneType]
        if kinds == [bool]:
            continue
        texts = (
            [value]
            if given
            else [*takewhile(lambda word: not _FLAG.match(word), arguments[number + 1 :])]
        )
        if get_origin(kinds[0]) is tuple:
            items = get_args(kinds[0])
            if Ellipsis not in items and len(texts) != len(items):
                return message(
                    "{flag}: {count} given; use {allowed}, separated by spaces",
                    flag=spelling,
                    count=len(texts),
                    allowed=valid,
                )
            kinds = [items[0]]
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


def misplaced(flag: str) -> Message:
    """Why the first argument must not be a flag, on one line."""
    spelling = flag.partition("=")[0].replace("_", "-")
    owners = [name for name in SUBCOMMANDS if spelling in spellings(load_subcommand(name))]
    if not owners:
        return message("{flag}: unknown flag; try: snowsplat --help", flag=printable(flag))
    return message(
        "{flag}: follows the name of a subcommand, as in: snowsplat {name} … {flag}",
        flag=printable(flag),
        name=owners[0],
    )


def spellings(command: type[Command]) -> dict[str, tuple[Any, Message]]:
    """Each spelling of a flag of a subcommand -> the type of its value, and what is allowed."""
    known = dict.fromkeys(("-h", "--help"), (bool, Message("")))
    for flag in flags_of(command):
        # The declaration is that of the setting, the type that of the command line.
        declared = (flag.declared,) if flag.type == flag.hint or flag.declared.parse else ()
        known |= dict.fromkeys(flag.spellings, (flag.type, allowed(flag.type, *declared)))
    return known


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


def advice(subcommand: str, name: str, flags: Collection[str]) -> str | None:
    """What to use for an unknown flag of a subcommand; None if it is not known.

    Args:
        name: the flag with "-" for "_", such as "--strategy.refine-every".
        flags: those that the subcommand has.
    """
    *groups, word = name.removeprefix("--").split(".")
    if word in _INPUTS and subcommand in SUBCOMMANDS:
        return f"use no flag: snowsplat {subcommand} {SUBCOMMANDS[subcommand].usage}"
    if (subcommand, name) in (("convert", "-s"), ("convert", "--source-path")):
        return "convert.py is snowsplat sfm -s DATASET"
    if groups and f"--{word}" in flags:
        return f"use --{word}"
    if word == "stop-overfitting":
        return "leave it out; it was removed, because the default recipe does not overfit"
    if word in ("save-ply", "disable-video"):
        return "leave it out; train writes the scene as PLY, and render writes videos"
    of_word = {w: new for new, words in _FLAGS.items() if new in flags for w in words.split()}
    new = next((of_word[w] for w in (word, *groups[::-1]) if w in of_word), None)
    return f"use {new}" if new else None
