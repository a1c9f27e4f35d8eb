"""What readers of scene files do with damaged ones: one error, to which `reads` adds the path."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np

from snowsplat.util.errors import UserError
from snowsplat.util.files import reading

P = ParamSpec("P")
T = TypeVar("T")


class Unsupported(UserError):
    """The file cannot be read as it is. A function that `reads` adds the path."""


class Damaged(Unsupported):
    """The file is damaged. A function that `reads` adds the path, and what to do."""


def reads(
    function: Callable[Concatenate[Path, P], T],
) -> Callable[Concatenate[Path | str, P], T]:
    """Decorates a function that reads a file, its first argument; it may raise `Unsupported`,
    OSError.

    NumPy does not warn of numbers that are not finite: such Gaussians are left out at the end.
    """

    @functools.wraps(function)
    def named(path: Path | str, *args: P.args, **kwargs: P.kwargs) -> T:
        try:
            with reading(Path(path)), np.errstate(all="ignore"):
                return function(Path(path), *args, **kwargs)
        except Damaged as error:
            raise UserError(
                "{path}: {error}; copy or export it again", path=path, error=error
            ) from None
        except Unsupported as error:
            raise UserError("{path}: {error}", path=path, error=error) from None

    return named
