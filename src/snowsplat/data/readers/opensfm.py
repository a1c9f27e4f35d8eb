"""OpenSfM and OpenDroneMap: reconstruction.json.

Poses are cam_from_world in OpenCV axes, with the rotation as a vector. Lengths in the photo are in
units of its larger side, from its centre. https://opensfm.org/docs/geometry.html describes them.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.data.lens.lens import Lens
from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import equirectangular, fisheye, perspective
from snowsplat.data.readers.reconstruction import PhotoFolder, Reconstruction, program
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import quoted

logger = logging.getLogger(__name__)

#: In a project of OpenDroneMap, there is a folder of OpenSfM.
PATTERNS = ("reconstruction.json", "opensfm/reconstruction.json")
_PERSPECTIVE = ("perspective", "brown", "simple_radial", "radial")
_FISHEYE = ("fisheye", "fisheye_opencv")
_SPHERICAL = ("spherical", "equirectangular")


def is_opensfm(path: Path) -> bool:
    """Whether a file starts like one of OpenSfM."""
    if path.suffix.lower() != ".json":
        return False
    head = parse.head_of(path, 1 << 16).lstrip(b"\xef\xbb\xbf \t\r\n")
    return head[:1] == b"[" and any(key in head for key in (b'"cameras"', b'"shots"'))


def read(path: Path, photos: PhotoFolder) -> Reconstruction:
    """Read cameras and points of the largest reconstruction."""
    scenes = list(parse.objects(path, parse.load_json(path)))
    shots = [parse.table(f"{path}: shots", scene.get("shots")) for scene in scenes]
    if not scenes:
        raise parse.damaged(path, "has no reconstruction")
    largest = max(range(len(scenes)), key=lambda i: len(shots[i]))
    if len(scenes) > 1:
        logger.warning(
            "%s: has %d separate reconstructions; using the largest (%d photos)",
            path,
            len(scenes),
            len(shots[largest]),
        )
    cameras = parse.table(f"{path}: cameras", scenes[largest].get("cameras"))
    lenses: dict[str, Lens] = {}
    found = Reconstruction(total=len(shots[largest]))
    for name, entry in shots[largest].items():
        where = f"{path}: shot {quoted(name)}"
        with found.one(name):
            shot = parse.table(where, entry)
            key = shot.get("camera")
            if not isinstance(key, str) or key not in cameras:
                raise parse.damaged(
                    where, f"has the camera {quoted(key)}, which is not in the file"
                )
            if (photo := found.photo(photos, name)) is None:
                continue
            if key not in lenses:
                lenses[key] = _lens(
                    f"{path}: camera {quoted(key)}", parse.table(where, cameras[key])
                )
            rotation = _rotation(parse.numbers(where, shot.get("rotation"), 3))
            pose = parse.rigid(where, rotation, parse.numbers(where, shot.get("translation"), 3))
            found.add(photos, photo, lenses[key], pose)
    where = f"{path}: points"
    entries = parse.table(where, scenes[largest].get("points") or {}).values()
    points = (parse.table(where, entry) for entry in entries)
    rows = ((point.get("coordinates"), point.get("color", [128.0] * 3)) for point in points)
    found.add_points(path, where, rows)
    return found


def _rotation(vector: np.ndarray) -> np.ndarray:
    """(3, 3) from axis × angle in radians, by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _lens(where: str, camera: dict[str, Any]) -> Lens:
    kind = camera.get("projection_type", "perspective")
    width, height = parse.number(where, camera, "width"), parse.number(where, camera, "height")
    if kind in _SPHERICAL:
        return equirectangular(where, width, height)
    if kind not in _PERSPECTIVE + _FISHEYE:
        raise UserError(
            "{where}: the camera model {kind} is not supported; run opensfm export_colmap, or "
            "opensfm undistort",
            where=where,
            kind=quoted(kind),
        )

    def value(key: str, default: float | None = 0.0) -> float:
        return parse.number(where, camera, key, default)

    unit = max(width, height)
    focal = parse.number(where, camera, "focal_x" if "focal_x" in camera else "focal")
    intrinsics = (
        unit * focal,
        unit * value("focal_y", focal),
        unit * value("c_x") + width / 2,
        unit * value("c_y") + height / 2,
    )
    radial = [value(key) for key in ("k1", "k2", "k3", "k4")]
    if kind in _FISHEYE:
        return fisheye(where, width, height, intrinsics, radial)
    return perspective(where, width, height, intrinsics, radial[:3], (value("p1"), value("p2")))


READER = program("OpenSfM", PATTERNS, is_opensfm, read)
