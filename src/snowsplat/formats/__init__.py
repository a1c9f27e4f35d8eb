"""Scene files: one module a format, one row a format in `FORMATS`.

A file is read as what its first bytes say it is, whatever it is called; only formats without a
signature are told by their names. It is written in the format that its name asks for.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from snowsplat.formats import ply
from snowsplat.formats.compressed_ply import (
    is_compressed_ply,
    read_compressed_ply,
    write_compressed_ply,
)
from snowsplat.formats.gltf import is_glb, read_glb, write_glb
from snowsplat.formats.ksplat import read_ksplat
from snowsplat.formats.sog import is_sog, read_sog, write_sog
from snowsplat.formats.splat import read_splat, write_splat
from snowsplat.formats.spz import is_spz, read_spz, write_spz
from snowsplat.scene.gaussians import Gaussians
from snowsplat.util.errors import UserError

__all__ = [
    "FORMATS",
    "Format",
    "format_for_reading",
    "format_for_writing",
    "read_gaussians",
    "register_format",
    "write_gaussians",
]

_HEAD_BYTES = 16_384


@dataclass(frozen=True)
class Format:
    """What the program knows about one kind of scene file.

    ``suffixes`` are lower case with their dots, as in ".compressed.ply"; the longest that fits a
    name counts. ``recognises`` is asked about the first 16,384 bytes of a file (fewer where it is
    shorter); None: the format has no signature. ``read`` and ``write`` are None where we do not.
    ``loses`` says to a user what a scene loses in it.
    """

    name: str
    suffixes: tuple[str, ...]
    recognises: Callable[[bytes], bool] | None
    read: Callable[[Path], Gaussians] | None
    write: Callable[[Path, Gaussians], None] | None
    loses: str


#: In the order in which `recognises` is asked: a special kind before the general one.
FORMATS: list[Format] = [
    Format(
        "compressed PLY",
        (".compressed.ply",),
        is_compressed_ply,
        read_compressed_ply,
        write_compressed_ply,
        "positions and scales have 10 to 11 bits, rotations 10, colours, opacity and SH 8",
    ),
    Format(
        "PLY",
        (".ply",),
        ply.is_ply,
        ply.read_gaussians,
        ply.write_gaussians,
        "nothing",
    ),
    Format(
        "SPZ",
        (".spz",),
        is_spz,
        read_spz,
        write_spz,
        "positions have 24 bits, rotations 10, all else 8 and SH 4 to 8",
    ),
    Format(
        "SOG",
        (".sog",),
        is_sog,
        read_sog,
        write_sog,
        "positions have 16 bits, all else 8; SH are rows of a palette",
    ),
    Format(
        "glTF",
        (".glb",),
        is_glb,
        read_glb,
        write_glb,
        "nothing but rounding",
    ),
    Format(
        "splat",
        (".splat",),
        None,
        read_splat,
        write_splat,
        "SH, all of it; rotations, colours and opacity have 8 bits",
    ),
    Format(
        "ksplat",
        (".ksplat",),
        None,
        read_ksplat,
        None,
        "positions and all else have 16 or 32 bits, SH 8 to 32",
    ),
]


def register_format(format: Format) -> None:
    """Add a format that a package above this one writes, such as an HTML page.

    Raises:
        ValueError: a format of that name is registered.
    """
    if any(known.name == format.name for known in FORMATS):
        raise ValueError(f"format {format.name} is already registered")
    FORMATS.append(format)


def read_gaussians(path: Path | str) -> Gaussians:
    """Read a scene file of any format we know, in the house frame.

    Raises:
        UserError: absent, of an unknown kind, damaged, or not a file of Gaussians.
    """
    path = Path(path)
    format = format_for_reading(path)
    if format.read is None:
        raise UserError(f"{path}: {format.name} files are written here, not read")
    return format.read(path)


def write_gaussians(path: Path | str, gaussians: Gaussians) -> None:
    """Write a scene file in the format its name asks for, atomically.

    Raises:
        UserError: a name that asks for no format that we write.
        OSError: the folder is absent or not writable, or the disk is full.
    """
    path = Path(path)
    write = format_for_writing(path).write
    assert write is not None
    write(path, gaussians)


def format_for_reading(path: Path | str) -> Format:
    """The format of a file that is there: by its first bytes, else by its name.

    Raises:
        UserError: not readable, or nothing that we know.
    """
    path = Path(path)
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise UserError(f"{path}: is a pipe or a device; name a file")
        with open(path, "rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
    for format in FORMATS:
        if format.recognises is not None and format.recognises(head):
            return format
    named = _by_name(path, FORMATS)
    if named is None:
        known = _suffixes([format for format in FORMATS if format.read is not None])
        raise UserError(f"{path}: not a scene file I know; I read {known}")
    return named


def format_for_writing(path: Path | str) -> Format:
    """The format that the name of a file asks for.

    Raises:
        UserError: none that we write.
    """
    path = Path(path)
    writable = [format for format in FORMATS if format.write is not None]
    format = _by_name(path, writable)
    if format is None:
        raise UserError(
            f"{path}: its name says no format that I write; end it in {_suffixes(writable)}"
        )
    return format


def _by_name(path: Path, formats: Sequence[Format]) -> Format | None:
    name = path.name.lower()
    fitting = [(len(s), f) for f in formats for s in f.suffixes if name.endswith(s)]
    return max(fitting, key=lambda pair: pair[0])[1] if fitting else None


def _suffixes(formats: Sequence[Format]) -> str:
    return ", ".join(suffix for format in formats for suffix in format.suffixes)
