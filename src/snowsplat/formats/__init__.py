"""Scene files: one module a format, told apart by their suffix."""

from pathlib import Path
from types import ModuleType

from snowsplat.errors import UserError
from snowsplat.formats import ply
from snowsplat.gaussians import Gaussians

__all__ = ["read_gaussians", "write_gaussians"]

_FORMATS = {".ply": ply}


def read_gaussians(path: Path | str) -> Gaussians:
    """Read a scene file of any format we know.

    Raises:
        UserError: absent, of an unknown kind, damaged, or not a file of Gaussians.
    """
    return _format_of(Path(path)).read_gaussians(path)


def write_gaussians(path: Path | str, gaussians: Gaussians) -> None:
    """Write a scene file in the format its suffix names, atomically.

    Raises:
        UserError: a suffix that names no format.
        OSError: the folder is absent or not writable, or the disk is full.
    """
    _format_of(Path(path)).write_gaussians(path, gaussians)


def _format_of(path: Path) -> ModuleType:
    try:
        return _FORMATS[path.suffix.lower()]
    except KeyError:
        known = ", ".join(_FORMATS)
        raise UserError(
            f"{path}: not a scene file I know; its name should end in {known}"
        ) from None
