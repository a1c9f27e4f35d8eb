"""`Command`: a subcommand is a class of settings, which are its arguments and flags, with `run`.

What all of them print is here, too.
"""

from __future__ import annotations

import json as json_text
import math
import shlex
import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar

from snowsplat.util.flags import settings_from
from snowsplat.util.messages import Message, as_message, message
from snowsplat.util.own_files import own_files
from snowsplat.util.settings import Settings, setting, switch

_OF_MESSAGE = {each.name for each in fields(Message)}


@dataclass(frozen=True, kw_only=True)
class Command(Settings):
    """The base of the subcommands. The docstring of a subcommand is its help text.

    Attributes:
        given: the values that were given in the command line or in a file, by the keys of the
            flags.
    """

    given: ClassVar[Mapping[str, Any]] = {}
    # `main` imports them before it parses the values of the flags, which they can extend.
    imports: tuple[Path, ...] = setting(
        (),
        "Run a Python file first, which registers parts of the training, recipes, starts, formats "
        "or subcommands of your own; repeat the flag for more.",
        metavar="FILE",
        name="import",
        repeated=True,
    )

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Command:
        """The subcommand for values of a command line, see `settings_from`."""
        command = settings_from(cls, given)
        object.__setattr__(command, "given", given)
        return command

    def run(self) -> Any:
        """Do it, and print the result for people; returns it for `--json`, or an `Exit`."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class JsonCommand(Command):
    """A subcommand whose result can be printed as JSON."""

    json: bool = switch("Print the result as JSON on stdout, and everything else on stderr.")


@dataclass(frozen=True)
class Exit:
    """The end of a subcommand with an exit code.

    Attributes:
        report: the result, as that of `Command.run`.
    """

    code: int
    report: Any = None


def run(command: Command) -> int:
    """Run a subcommand; returns its exit code.

    With ``json``, stdout gets one JSON value, or nothing if there is no result.
    """
    as_json = isinstance(command, JsonCommand) and command.json
    with redirect_stdout(sys.stderr if as_json else sys.stdout):
        result = command.run()
    end = result if isinstance(result, Exit) else Exit(0, result)
    if as_json and end.report is not None:
        print(json_text.dumps(plain(end.report), indent=2, allow_nan=False), flush=True)
    return end.code


def plain(value: Any) -> Any:
    """A value of JSON: dataclasses are objects, paths and messages are texts, and numbers that are
    not finite are null."""
    if isinstance(value, Mapping) and value.keys() == _OF_MESSAGE:
        value = Message.from_json(value)
    if isinstance(value, Message):
        return str(value)
    if hasattr(value, "as_json"):
        return plain(value.as_json())
    if is_dataclass(value):
        return {each.name: plain(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def print_message(key: str | Message, /, **values: Any) -> None:
    """Print a message at once, in the language of the program; see `message`."""
    print(Message(key, values) if isinstance(key, str) else as_message(key), flush=True)


def next_step(purpose: Message, *words: object) -> Message:
    """A purpose and the command for it: "to see it: snowsplat view 'my garden'"."""
    own = [word for file in own_files() for word in ("--import", file)]
    command = shlex.join(["snowsplat", *map(str, words), *own])
    return message("{purpose}: {command}", purpose=purpose, command=command)


def see_and_share(scene: Path) -> Message:
    """How to see and share a scene: a file, or the output folder of `train` or `make`."""
    name = scene.resolve().name.split(".")[0].removesuffix("_scene") or "scene"
    see = next_step(message("to see it"), "view", scene)
    share = next_step(message("to share it"), "publish", scene, "-o", f"{name}_site")
    return message("{see}; {share}", see=see, share=share)
