"""Options that several subcommands have, as fields of their options."""

from __future__ import annotations

import math

from snowsplat.training.settings.recipes import check_recipe
from snowsplat.util.byte_size import parse_bytes
from snowsplat.util.settings import setting


def minutes() -> float | None:
    """A duration in minutes; None: any."""
    allowed = "a number above 0"
    return setting(None, "Finish within this time.", above=0.0, allowed=allowed, check=_endless)


def _endless(minutes: float) -> str | None:
    return None if math.isfinite(60.0 * minutes) else "is not a duration"


def memory() -> int | str | None:
    """A number of bytes, or a text such as "4GB"; None: no limit."""
    return setting(None, "Memory limit.", above=0, allowed="e.g. 4GB or 800MB", check=_size)


def _size(memory: int | str) -> str | None:
    if isinstance(memory, str):
        parse_bytes(memory)  # raises an error about `memory`
    return None


def resolution() -> int | None:
    """A divisor of the size of the photos, or their width; None or -1: unchanged."""
    allowed = "1, 2, 4, 8 or a width"
    return setting(
        None,
        "Size of the photos.",
        allowed=allowed,
        check=lambda number: None if number == -1 or number >= 1 else "is not valid",
    )


def hold_out() -> int | None:
    """Every N-th photo is held out; None: none."""
    return setting(None, "Hold out every N-th photo.", least=1, allowed="2 or more")


def first_held_out() -> int | None:
    """The index of the first photo that is held out; None: 0."""
    return setting(None, "Index of the first held-out photo.", least=0)


def recipe() -> str | None:
    """The name of a recipe; None: the default one, or that of the checkpoint."""
    return setting(None, "Name of the recipe.", check=check_recipe)
