"""The table of the scene file formats, and how a format is found for a file.

The format of a file to read is recognised by its first bytes, not by its name. Only formats without
a signature are recognised by the suffix. The format of a file to write is selected by the suffix.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from snowsplat.formats.archive import is_archive, read_archive
from snowsplat.formats.compressed_ply import (
    is_compressed_ply,
    read_compressed_ply,
    write_compressed_ply,
)
from snowsplat.formats.gaussian_arrays import GaussianArrays
from snowsplat.formats.gltf import is_glb, is_gltf, read_gltf, write_glb
from snowsplat.formats.gsplat_checkpoint import is_checkpoint, read_checkpoint
from snowsplat.formats.ksplat import read_ksplat
from snowsplat.formats.lod import INDEX, LEVELS, is_lod, lod_bytes, read_lod
from snowsplat.formats.lod_writer import write_lod
from snowsplat.formats.ply import is_ply, read_ply, write_ply
from snowsplat.formats.sog import is_sog, read_sog, sog_version, write_sog
from snowsplat.formats.splat import read_splat, write_splat
from snowsplat.formats.spz import is_spz, read_spz, spz_version, write_spz
from snowsplat.formats.usd import is_usd, read_usd, write_usd
from snowsplat.util.errors import UserError
from snowsplat.util.files import reading
from snowsplat.util.messages import Message, message

_HEAD_BYTES = 16_384


class UnknownFormatError(UserError):
    """A file is of none of the known formats."""


@dataclass(frozen=True)
class Format:
    """One format of scene files.

    Attributes:
        name: the name for users.
        suffixes: lower case with their dots, as in ".compressed.ply"; the longest match counts. One
            that begins with "/" is a complete name, of a file that describes its folder.
        recognises: whether a file with these first 16,384 bytes (fewer if it is shorter) has this
            format; None for a format without a signature.
        read: None for a format that cannot be read.
        write: takes a path and `GaussianArrays`; None for a format that cannot be written.
        loses: a description, for users, of the data that a scene loses in this format.
        marks_antialiased: whether a file can say that its scene is antialiased, see `Gaussians`.
        version: the version of a file that ``recognises`` accepts, if the format has several.
        stores_origin: whether a file has the `scene.origin` and the true scale; if not, they are in
            a file beside it.
        bytes: the size of a scene; None: the scene is a single file, whose size is taken.
        instead: for users, what to do with a file of a format that cannot be read.
    """

    name: str
    suffixes: tuple[str, ...]
    recognises: Callable[[bytes], bool] | None
    read: Callable[[Path], GaussianArrays] | None
    write: Callable[..., None] | None
    loses: Message
    marks_antialiased: bool = False
    version: Callable[[Path], str] | None = None
    stores_origin: bool = False
    bytes: Callable[[Path], int] | None = None
    instead: str = ""

    def size(self, path: Path) -> int:
        """The bytes of an existing scene, with all files that belong to it."""
        return self.bytes(path) if self.bytes else path.stat().st_size


#: Suffixes of formats that hold no Gaussians.
_SURFACES = (".obj", ".stl", ".fbx", ".dae", ".3mf", ".las", ".laz", ".e57")
_UNMARKED = message("the antialiased mark")
_ROUNDED = message("nothing except for rounding and the antialiased mark")

#: ``recognises`` is called in this order: special formats are before general ones.
FORMATS: list[Format] = [
    Format(
        "compressed PLY",
        (".compressed.ply",),
        is_compressed_ply,
        read_compressed_ply,
        write_compressed_ply,
        message(
            "precision: positions and scales have 10 to 11 bits, rotations 10, all other values 8"
        ),
        True,
        stores_origin=True,
    ),
    Format(
        "PLY", (".ply",), is_ply, read_ply, write_ply, message("nothing"), True, stores_origin=True
    ),
    Format(
        "SPZ",
        (".spz",),
        is_spz,
        read_spz,
        write_spz,
        message("precision: positions have 24 bits, rotations 10, SH 4 to 8, all other values 8"),
        True,
        spz_version,
    ),
    Format("gsplat checkpoint", (".pt",), is_checkpoint, read_checkpoint, None, _UNMARKED),
    Format(
        "USD",
        (".usd", ".usdc", ".usda", ".usdz"),
        is_usd,
        read_usd,
        write_usd,
        _ROUNDED,
        stores_origin=True,
    ),
    Format(
        "zip file",
        (".zip", ".ssproj"),
        is_archive,
        read_archive,
        None,
        message("nothing that the file in it has"),
        True,
        stores_origin=True,
    ),
    Format(
        "SOG",
        (".sog",),
        is_sog,
        read_sog,
        write_sog,
        message("precision: positions have 16 bits, all other values 8; SH are rows of a palette"),
        True,
        sog_version,
        stores_origin=True,
    ),
    Format(
        LEVELS,
        (f"/{INDEX}",),
        is_lod,
        read_lod,
        write_lod,
        message("precision: positions have 16 bits, all other values 8; SH are rows of palettes"),
        True,
        stores_origin=True,
        bytes=lod_bytes,
    ),
    Format(
        "glTF",
        (".glb",),
        is_glb,
        read_gltf,
        write_glb,
        _ROUNDED,
        version=lambda _: "2, KHR_gaussian_splatting",
        stores_origin=True,
    ),
    Format(
        "glTF in JSON",
        (".gltf",),
        is_gltf,
        read_gltf,
        None,
        _ROUNDED,
        version=lambda _: "2, KHR_gaussian_splatting",
        stores_origin=True,
    ),
    Format(
        "splat",
        (".splat",),
        None,
        read_splat,
        write_splat,
        message(
            "all SH, the antialiased mark, colours beyond black and white; rotations, colours and "
            "opacity have 8 bits"
        ),
    ),
    Format(
        "ksplat",
        (".ksplat",),
        None,
        read_ksplat,
        None,
        message("precision: SH have 8 to 32 bits, all other values 16 or 32; the antialiased mark"),
    ),
    Format(
        "RAD",
        (".rad", ".radc"),
        lambda head: head.startswith((b"RAD0", b"RADC")),
        None,
        None,
        message("not known"),
        instead="use the file that Spark made it from, or the .spz of its build-lod --unlod --spz",
    ),
    Format(
        "LCC",
        (".lcc", ".lcc2"),
        None,
        None,
        None,
        message("not known"),
        instead="export the scene as .ply, or convert it with splat-transform",
    ),
]


def register_format(format: Format) -> None:
    """Add a format that a package above this one implements, such as the HTML page.

    Raises:
        ValueError: a format of that name is already registered.
    """
    if any(known.name == format.name for known in FORMATS):
        raise ValueError(f"format {format.name} is already registered")
    FORMATS.append(format)


def format_for_reading(path: Path | str) -> Format:
    """The format of an existing file: by its first bytes, else by its suffix.

    Raises:
        UserError: the file cannot be read, or its format is unknown.
    """
    path = Path(path)
    with reading(path):
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise UserError("{path}: is a pipe or a device; use a file", path=path)
        with open(path, "rb") as file:
            head = file.read(_HEAD_BYTES)
    for format in FORMATS:
        if format.recognises is not None and format.recognises(head):
            return format
    named = _by_suffix(path, FORMATS)
    if named is None:
        known = _suffixes([format for format in FORMATS if format.read is not None])
        raise UnknownFormatError(
            "{path}: not a known scene file; supported are {known}", path=path, known=known
        )
    return named


def format_for_writing(path: Path | str) -> Format:
    """The format that the suffix of a file name selects.

    Raises:
        UserError: no format that can be written has this suffix.
    """
    path = Path(path)
    writable = [format for format in FORMATS if format.write is not None]
    format = _by_suffix(path, writable)
    if format is None and path.suffix.lower() in _SURFACES:
        raise UserError(
            "{path}: is a format of triangles or points, not of Gaussians; use snowsplat mesh or "
            "snowsplat points",
            path=path,
        )
    if format is None:
        raise UserError(
            "{path}: the suffix selects no scene format; use one of {suffixes}",
            path=path,
            suffixes=_suffixes(writable),
        )
    return format


def _by_suffix(path: Path, formats: Sequence[Format]) -> Format | None:
    name = f"/{path.name.lower()}"
    matching = [(len(s), f) for f in formats for s in f.suffixes if name.endswith(s)]
    return max(matching, key=lambda pair: pair[0])[1] if matching else None


def _suffixes(formats: Sequence[Format]) -> str:
    return ", ".join(suffix for format in formats for suffix in format.suffixes)
