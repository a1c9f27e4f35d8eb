"""Polycam: the raw data of a capture, https://github.com/PolyCam/polyform.

``keyframes/`` has one JSON file for each photo. ``corrected_cameras`` and ``corrected_images`` are
the result of Polycam's own adjustment; without them, the poses are those of ARKit. A camera has y
up and looks along −z; units are metres. Depth maps have millimetres;
maps of their confidence are 0 where it is low.
"""

from pathlib import Path

import numpy as np

from snowsplat.data.photos.decode import read_header
from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import perspective
from snowsplat.data.readers.reconstruction import PhotoFolder, Reconstruction, program
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import is_file

# Folders of cameras and of their photos.
_PAIRS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
#: The folders of cameras, those with the best poses first.
PATTERNS = tuple(f"{place}{cameras}" for place in ("keyframes/", "") for cameras, _ in _PAIRS)
_MILLIMETRE = 1e-3


def is_polycam(cameras: Path) -> bool:
    """Whether a folder describes the cameras of photos in a folder beside it, with poses."""
    images = cameras.parent / dict(_PAIRS).get(cameras.name, "")
    first = min(cameras.glob("*.json"), default=None) if images.is_dir() else None
    try:
        values = parse.load_json(first) if first else None
    except UserError:
        return False
    return isinstance(values, dict) and "fx" in values and "t_23" in values


def photos(folder: Path) -> Path | None:
    """The folder of photos in a capture, also if its cameras have no poses."""
    for pattern in PATTERNS:
        cameras = folder / pattern
        images = cameras.with_name(dict(_PAIRS)[cameras.name])
        if images.is_dir() and any(cameras.glob("*.json")):
            return images
    return None


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
        with found.one(file.name):
            if (photo := found.photo(photos, f"{prefix}/{images}/{file.stem}")) is None:
                continue
            values = parse.table(file, parse.load_json(file))
            fx, fy, cx, cy = (parse.number(file, values, key) for key in ("fx", "fy", "cx", "cy"))
            if "width" not in values:  # as in corrected cameras since 2025
                header = read_header(photos.root / photo)
                values |= {"width": header.width, "height": header.height}
            width, height = (
                parse.number(file, values, "width"),
                parse.number(file, values, "height"),
            )
            lens = perspective(file, width, height, (fx, fy, cx, cy))
            entries = [parse.number(file, values, f"t_{i // 4}{i % 4}") for i in range(12)]
            pose = parse.from_opengl(file, np.reshape(entries, (3, 4)))
            depth = next((d for d in (f / f"{file.stem}.png" for f in depths) if is_file(d)), None)
            confidence = keyframes / "confidence" / f"{file.stem}.png"
            known = confidence if is_file(confidence) else None
            maps = {"depth": depth, "depth_unit": _MILLIMETRE, "depth_confidence": known}
            found.add(photos, photo, lens, pose, **maps)
    return found


READER = program("Polycam", PATTERNS, is_polycam, read, photos, 1.0)
