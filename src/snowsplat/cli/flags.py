"""How a field of a subcommand's dataclass becomes a flag."""

from typing import Any

import tyro


def flag(metavar: str, *aliases: str, default: str = "") -> Any:
    """A flag with the placeholder ``metavar`` for its value.

    ``aliases`` are other spellings, and ``default`` describes the default in the help text. tyro
    accepts hyphens and underscores alike in every spelling.
    """
    hint = f"(default: {default})" if default else ""
    return tyro.conf.arg(metavar=metavar, aliases=list(aliases) or None, help_behavior_hint=hint)


def switch(*aliases: str) -> Any:
    """A flag without a value."""
    return tyro.conf.arg(aliases=list(aliases) or None, help_behavior_hint="")
