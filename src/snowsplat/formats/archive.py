"""Zip files around a scene: a PLY as apps export it. What is in others is named in the error."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

from snowsplat.formats.compressed_ply import is_compressed_ply, read_compressed_ply
from snowsplat.formats.damage import Unsupported, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, without_unusable
from snowsplat.formats.ply import is_ply, is_scene, read_ply
from snowsplat.formats.sog import read_sog
from snowsplat.formats.sog_container import meta_folder
from snowsplat.formats.zip_members import ZipMembers
from snowsplat.util.messages import message
from snowsplat.util.ply import open_table
from snowsplat.util.safe_json import quoted

# Rows of zeros, as for normals and unused SH, are packed to nearly nothing.
_MOST_INFLATION = 16
_PROJECT = "document.json"  # of SuperSplat
_OTHER_SCENES = (".spz", ".splat", ".ksplat", ".sog", ".glb", ".gltf", ".usd", ".usda", ".usdc")
_MOST_SCENES = 1000


def first_member(head: bytes) -> str | None:
    """The name of the first member of a zip file that begins with ``head``; None: no zip file."""
    if not head.startswith(b"PK\x03\x04") or len(head) < 30:
        return None
    (length,) = struct.unpack_from("<H", head, 26)
    return head[30 : 30 + length].decode("utf-8", "replace")


def is_archive(head: bytes) -> bool:
    """Whether a file that begins with ``head`` is a zip file that is probably not a SOG scene."""
    name = first_member(head)
    return name is not None and not (name == "meta.json" or name.endswith((".webp", ".png")))


@reads
def read_archive(path: Path) -> GaussianArrays:
    """Read the scene in a zip file.

    Raises: UserError: the file cannot be read, is damaged, or contains no scene, several scenes, or
    one of a kind that is only read on its own.
    """
    with ZipMembers(path) as members:
        names = [name for name in members.names() if _is_own(name)]
        if meta_folder(names) is not None:
            return read_sog(path)
        if _PROJECT in names:
            raise Unsupported("a project of SuperSplat; export its scene as a .ply")
        return _single(path, members, names)


def _is_own(name: str) -> bool:
    """Not one of the files that macOS adds."""
    return not name.startswith("__MACOSX/") and not Path(name).name.startswith("._")


def _single(path: Path, members: ZipMembers, names: Sequence[str]) -> GaussianArrays:
    """The only PLY with Gaussians."""
    found: list[GaussianArrays] = []
    scenes: list[str] = []
    for name in [name for name in names if name.lower().endswith(".ply")][:_MOST_SCENES]:
        data, inner = members.read(name, _MOST_INFLATION), path / name
        if is_compressed_ply(data[:16_384]) or (
            is_ply(data) and is_scene(open_table(inner, data=data))
        ):
            scenes.append(name)
            found = found or [_read(inner, data)]
    if len(scenes) == 1:
        return found[0]
    if scenes:
        raise Unsupported(
            "contains {scenes} scenes; unzip it, and use {some}",
            scenes=len(scenes),
            some=_some(scenes),
        )
    others = [name for name in names if name.lower().endswith(_OTHER_SCENES)]
    if others:
        raise Unsupported("a zip file; unzip it, and use {some}", some=_some(others))
    raise Unsupported(
        "a zip file without a scene; it contains {some}",
        some=_some(names) or message("nothing"),
    )


def _some(names: Sequence[str]) -> str:
    return ", ".join(map(quoted, names[:3])) + (", …" if len(names) > 3 else "")


def _read(path: Path, data: bytes) -> GaussianArrays:
    if is_compressed_ply(data[:16_384]):
        return read_compressed_ply(path, data)
    return without_unusable(path, read_ply(path, data))
