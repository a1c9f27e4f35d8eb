"""Options that several functions have, as fields of their options."""

import math
from pathlib import Path
from typing import Any

from snowsplat.training.settings.recipes import RECIPES, check_recipe
from snowsplat.util.byte_size import parse_bytes
from snowsplat.util.settings import flag, setting, switch


def minutes(help: str) -> float | None:
    """A duration in minutes; None: any."""
    return flag(
        None,
        help,
        "none",
        above=0.0,
        check=lambda given: None if math.isfinite(60.0 * given) else "is not a duration",
    )


def memory() -> int | str | None:
    """A number of bytes, or a text such as "4GB"; None: no limit."""
    return setting(
        None,
        "Memory limit of the training, for example 4GB. On a GPU, this is memory of the GPU; on "
        "the CPU, it is memory in addition to that of Python and its libraries. To stay within the "
        "limit, photos are decoded each time they are used, and the maximum number of Gaussians is "
        "reduced.",
        "no limit",
        above=0,
        allowed="e.g. 4GB or 800MB",
        check=_size,
        parse=str,
        metavar="BYTES",
    )


def _size(memory: int | str) -> str | None:
    if isinstance(memory, str):
        parse_bytes(memory)  # raises an error about `memory`
    return None


def images() -> str | None:
    """The folder of the photos; None: "images"."""
    help = "Name of the folder with the photos, in the folder of the dataset."
    return setting(None, help, "images", metavar="NAME", aliases=("-i",))


def resolution(otherwise: str) -> int | None:
    """A divisor of the size of the photos, or their width; None or -1: unchanged."""
    return flag(
        None,
        "With 1, 2, 4 or 8, the width and height of the photos are divided by this number. Any "
        "other number is the new width in pixels.",
        otherwise,
        allowed="1, 2, 4, 8 or a width",
        check=lambda number: None if number == -1 or number >= 1 else "is not valid",
        aliases=("-r",),
    )


def hold_out(help: str) -> int | None:
    """Every N-th photo is held out; None: none."""
    return setting(
        None,
        help,
        least=1,
        allowed="2 or more",
        metavar="",
        name="eval",
        means=8,
    )


def test_list() -> Path | None:
    """The file with the names of the photos to hold out; None: none."""
    help = "Text file with the names of the photos to hold out, one per line. Implies --eval."
    return setting(None, help, metavar="FILE")


def recipe(value: Any, help: str) -> Any:
    """The name of a recipe; None: the default one, or that of the checkpoint."""
    names = f"{{{','.join(RECIPES)}}}"
    return setting(value, help, "default", check=check_recipe, metavar=names)


def iteration() -> int | None:
    """The step of the scene; None: the last one."""
    help = "If OUT contains several scenes, the step after which the scene was saved."
    return flag(None, help, "the last step")


def overwrite(help: str = "Replace FILE if it exists already.") -> bool:
    """Whether an earlier result is replaced."""
    return switch(help)


def dataset(*aliases: str) -> Path | None:
    """The dataset of a scene; None: that of its training."""
    return setting(
        None,
        "Folder of the dataset: for a scene file, or if it was moved after the training.",
        "as trained",
        metavar="DATASET",
        aliases=("-s", *aliases),
    )


def quiet() -> bool:
    """Whether no progress is printed."""
    return switch("Print only the result and no progress.", "-q")
