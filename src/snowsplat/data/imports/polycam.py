"""Polycam: the raw data of a capture, https://github.com/PolyCam/polyform.

``keyframes/`` has one JSON file for each photo. ``corrected_cameras`` and ``corrected_images`` are
the result of Polycam's own adjustment; without them, the poses are those of ARKit. A camera has y
up and looks along −z; units are metres. Depth maps have millimetres;
maps of their confidence are 0 where it is low.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from snowsplat.data.imports.lenses import perspective
from snowsplat.data.imports.photos import PhotoFolder
from snowsplat.data.imports.reconstruction import Reconstruction, Shot
from snowsplat.data.imports.values import from_opengl, load_json, number, table
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import is_file

#: Folders of cameras and of their photos; the first that both exist are used.
_PAIRS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
_MILLIMETRE = 1e-3


def find(folder: Path) -> Iterator[Path]:
    """The folder of cameras in a capture, if they have poses."""
    for cameras, _ in _folders(folder):
        first = min(cameras.glob("*.json"))
        try:
            values = load_json(first)
        except UserError:
            values = {}
        if isinstance(values, dict) and "fx" in values and "t_23" in values:
            yield cameras


def photos(folder: Path) -> Path | None:
    """The folder of photos in a capture."""
    return next((images for _, images in _folders(folder)), None)


def read(path: Path, photos: PhotoFolder) -> Reconstruction:
    """Read the cameras of the folder ``path``, and the depth maps beside it."""
    keyframes = path.parent
    images = dict(_PAIRS)[path.name]
    prefix = keyframes.relative_to(photos.root).as_posix()
    # Some versions correct the depth maps too.
    depths = [keyframes / path.name.replace("cameras", "depth"), keyframes / "depth"]
    found = Reconstruction()
    for file in sorted(path.glob("*.json")):
        found.total += 1
        photo = photos.find(f"{prefix}/{images}/{file.stem}")
        if photo is None:
            found.missing.append(file.stem)
            continue
        values = table(file, load_json(file))
        fx, fy, cx, cy = (number(file, values, key) for key in ("fx", "fy", "cx", "cy"))
        width, height = number(file, values, "width"), number(file, values, "height")
        lens = perspective(file, width, height, (fx, fy, cx, cy))
        entries = [
            number(file, values, f"t_{row}{column}") for row in range(3) for column in range(4)
        ]
        pose = from_opengl(file, np.reshape(entries, (3, 4)))
        depth = next((d for d in (f / f"{file.stem}.png" for f in depths) if is_file(d)), None)
        confidence = keyframes / "confidence" / f"{file.stem}.png"
        found.shots.append(
            Shot(photo, lens, pose, depth, _MILLIMETRE, confidence if is_file(confidence) else None)
        )
    return found


def _folders(folder: Path) -> Iterator[tuple[Path, Path]]:
    """The folders of cameras and of photos, those with the best poses first."""
    for place in (folder / "keyframes", folder):
        for cameras, images in _PAIRS:
            if (place / images).is_dir() and any((place / cameras).glob("*.json")):
                yield place / cameras, place / images
