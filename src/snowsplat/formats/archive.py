"""Zip files around a scene: a PLY as apps export it, or a project of SuperSplat (`.ssproj`).

A project has `document.json` and `splat_0.ply`, `splat_1.ply`, …; "splats" in the document places
them: position, rotation (xyzw) and scale, in the frame of a PLY turned by 180° about z.

What is in other zip files is named in the error message.
"""

import logging
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.formats.compressed_ply import is_compressed_ply, read_compressed_ply
from snowsplat.formats.damage import Damaged, Unsupported, reads
from snowsplat.formats.gaussian_arrays import GaussianArrays, without_unusable
from snowsplat.formats.ply import is_ply, is_scene, read_ply
from snowsplat.formats.sog import read_sog
from snowsplat.formats.sog_container import meta_folder
from snowsplat.formats.zip_members import ZipMembers
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.util.ply import open_table
from snowsplat.util.safe_json import parse_json, quoted

logger = logging.getLogger(__name__)

# Rows of zeros, as for normals and unused SH, are packed to nearly nothing.
_MOST_INFLATION = 16
_DOCUMENT = "document.json"
_SPLAT = re.compile(r"splat_(\d{1,4})\.ply")
_OTHER_SCENES = (".spz", ".splat", ".ksplat", ".sog", ".glb", ".gltf", ".usd", ".usda", ".usdc")
_MOST_SCENES = 1000
# The settings of a splat that change its colours, and their neutral values.
_COLORS = {
    "tintClr": [1, 1, 1],
    "temperature": 0,
    "saturation": 1,
    "brightness": 0,
    "blackPoint": 0,
    "whitePoint": 1,
    "transparency": 1,
}


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
        if _DOCUMENT in names and any(_SPLAT.fullmatch(name) for name in names):
            return _project(path, members, names)
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


def _project(path: Path, members: ZipMembers, names: Sequence[str]) -> GaussianArrays:
    """The visible splats of a project, at their places."""
    settings = _settings(members)
    numbers = sorted(int(match[1]) for match in map(_SPLAT.fullmatch, names) if match)
    parts, hidden, colored = [], 0, False
    for number in numbers[:_MOST_SCENES]:
        name = f"splat_{number}.ply"
        own = settings[number] if number < len(settings) else {}
        if own.get("visible") is False:
            hidden += 1
            continue
        colored |= any(_differs(own.get(key), neutral) for key, neutral in _COLORS.items())
        parts.append(_place(_read(path / name, members.read(name, _MOST_INFLATION)), own))
    if hidden:
        logger.warning("%s: %d hidden splats of the project are left out", path, hidden)
    if colored:
        logger.warning("%s: the colour settings of the project are not applied", path)
    return GaussianArrays.cat(parts)


def _settings(members: ZipMembers) -> list[dict[str, Any]]:
    """The settings of each splat."""
    try:
        document = parse_json(members.read(_DOCUMENT, _MOST_INFLATION))
    except ValueError:
        raise Damaged("its {document} is not valid JSON", document=_DOCUMENT) from None
    splats = document.get("splats") if isinstance(document, dict) else None
    found = splats if isinstance(splats, list) else []
    return [each if isinstance(each, dict) else {} for each in found]


def _differs(value: object, neutral: object) -> bool:
    if isinstance(neutral, list):
        return isinstance(value, list) and value[: len(neutral)] != neutral
    return value is not None and value != neutral


def _place(scene: GaussianArrays, settings: dict[str, Any]) -> GaussianArrays:
    """The splats in the frame of a PLY. Raises: Damaged: the settings are no similarity."""
    if "position" not in settings:
        return scene
    import torch

    from snowsplat.scene.edit import transform_world
    from snowsplat.scene.geometry import Similarity, rotation_from_quat

    try:
        x, y, z, w = (float(value) for value in settings["rotation"])
        position = np.array([float(value) for value in settings["position"]]).reshape(3)
        scale = [float(value) for value in settings["scale"]]
    except (KeyError, TypeError, ValueError, OverflowError):
        raise Damaged("its {document} has no valid positions", document=_DOCUMENT) from None
    length = float(np.linalg.norm([x, y, z, w]))
    finite = np.isfinite([*position, *scale, length]).all()
    if (
        not finite
        or not min(scale, default=0) > 0
        or max(scale) > 1.0001 * min(scale)
        or not length
    ):
        raise Damaged(
            "its {document} stretches or mirrors a splat; apply this in SuperSplat",
            document=_DOCUMENT,
        )
    back = np.diag([-1.0, -1.0, 1.0])  # by 180° about z
    turn = rotation_from_quat(torch.tensor([w, x, y, z], dtype=torch.float64) / length).numpy()
    rotation, offset = back @ turn, back @ position
    if scale[0] == 1 and not offset.any() and np.allclose(rotation, np.eye(3), atol=1e-6):
        return scene
    similarity = Similarity(scale[0], torch.from_numpy(rotation), torch.from_numpy(offset))
    try:
        placed = transform_world(scene.to_gaussians(), similarity)
    except UserError:  # larger than float32 can represent
        raise Damaged("its {document} has no valid positions", document=_DOCUMENT) from None
    return GaussianArrays.from_gaussians(placed)
