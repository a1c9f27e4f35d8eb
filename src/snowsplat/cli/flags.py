"""How a field of a subcommand's dataclass becomes a flag; the flags of settings in messages."""

import re
from typing import Annotated, Any, TypeAlias

import tyro

from snowsplat.scene.length import metres_of
from snowsplat.util.errors import SettingError
from snowsplat.util.messages import as_message

_SETTING = re.compile(r"`([a-z][a-z0-9_]*)`")
# Settings whose flag has another name.
_OTHER_NAMES = {"hold_out": "--eval"}


def flag(metavar: str, *aliases: str, default: str = "", help: str | None = None) -> Any:
    """A flag with the placeholder ``metavar`` for its value.

    ``aliases`` are other spellings, and ``default`` describes the default in the help text. tyro
    accepts hyphens and underscores alike in every spelling. ``help``: None: the string below the
    field.
    """
    hint = f"(default: {default})" if default else ""
    return tyro.conf.arg(
        metavar=metavar, aliases=list(aliases) or None, help_behavior_hint=hint, help=help
    )


def switch(*aliases: str, help: str | None = None) -> Any:
    """A flag without a value."""
    return tyro.conf.arg(aliases=list(aliases) or None, help_behavior_hint="", help=help)


# Flags that several subcommands have.
Threads: TypeAlias = Annotated[
    int | None, flag("N", default="all cores", help="Number of CPU threads.")
]
Marker: TypeAlias = Annotated[
    str | None,
    flag(
        "LENGTH",
        default="none",
        help="Side of the black square of ArUco or AprilTag markers that lie in the scene, e.g. "
        "0.10m, 10cm, 4in: one unit of the scene is then one metre. Markers that lie flat also "
        "tell up.",
    ),
]
Quiet: TypeAlias = Annotated[bool, switch("-q", help="Print only the result and no progress.")]


def marker_side(text: str | None) -> float | None:
    """The value of `Marker` in metres. Raises: SettingError: it is no length."""
    try:
        return None if text is None else metres_of(text)
    except ValueError as error:
        raise SettingError("marker", as_message(error)) from None


def with_flags(message: str) -> str:
    """A message of the library for the command line: "use `overwrite`" -> "use --overwrite"."""
    return _SETTING.sub(
        lambda match: _OTHER_NAMES.get(match[1], "--" + match[1].replace("_", "-")), message
    )
