"""The arguments of a command line, parsed by tyro from the declarations of a subcommand."""

import inspect
from collections.abc import Sequence
from dataclasses import field, make_dataclass
from keyword import iskeyword
from typing import Annotated, Any, Optional, Union

import tyro

from snowsplat.cli.command import Command
from snowsplat.util.flags import Flag, flags_of, with_flags


def parse(
    name: str, arguments: Sequence[str], commands: dict[str, type[Command] | None]
) -> dict[str, Any]:
    """The given values of the arguments of a subcommand, by the keys of their flags.

    ``commands``: all names; None: without its flags, which are not needed here.

    Raises: SystemExit: help was printed, or the arguments are invalid.
    """
    union: Any = Union[tuple(_choice(*each) for each in commands.items())]  # noqa: UP007
    parsed = tyro.cli(
        union, prog="snowsplat", args=[name, *arguments], config=(tyro.conf.FlagCreatePairsOff,)
    )
    return {
        flag.key: value
        for command in commands.values()
        for flag in (flags_of(command) if command is not None else ())
        if (value := getattr(parsed, _attribute(flag))) != _not_given(flag)
    }


def _choice(name: str, command: type[Command] | None) -> Any:
    flags = flags_of(command) if command is not None else ()
    kind = make_dataclass(name.capitalize(), [_field(flag) for flag in flags])
    text = inspect.cleandoc(command.__doc__ or "") if command is not None else ""
    return Annotated[kind, tyro.conf.subcommand(name, description=text)]


def _field(flag: Flag) -> tuple[str, Any, Any]:
    declared, kind, value = flag.declared, flag.type, _not_given(flag)
    marks: list[Any] = [
        tyro.conf.arg(
            name=flag.key if iskeyword(flag.key) else None,
            metavar=declared.metavar or None,
            aliases=list(declared.aliases) or None,
            help_behavior_hint=f"(default: {flag.default})" if flag.default else "",
        )
    ]
    if declared.argument:
        marks.append(tyro.conf.Positional)
    if declared.repeated:
        marks.append(tyro.conf.UseAppendAction)
    if value is None:
        # Not `kind | None`: to check it, tyro would import another package, which takes a tenth of
        # a second.
        kind = Optional[kind]  # noqa: UP045
    help = with_flags(declared.help)
    parts = (kind, *marks)
    annotated: Any = Annotated[parts]
    return _attribute(flag), annotated, field(default=value, metadata={"help": help})


def _attribute(flag: Flag) -> str:
    """The name of its field."""
    return f"{flag.key}_" if iskeyword(flag.key) else flag.key


def _not_given(flag: Flag) -> Any:
    """The value of a flag that is not given."""
    if flag.type is bool:
        return False
    return () if flag.is_list and (flag.declared.argument or flag.declared.repeated) else None
