"""AliceVision, Meshroom: cameras.sfm or sfm.json. Without points, which are in a file of Alembic.

The rotation is stored by columns, cam_from_world, in OpenCV axes. The centre of the first pixel is
at (0, 0). The principal point is relative to the centre of the photo.
"""

from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.data.lens.lens import Lens
from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import fisheye, perspective
from snowsplat.data.readers.points import points_beside
from snowsplat.data.readers.reconstruction import PhotoFolder, Reconstruction, program
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import quoted

# The coefficients of each kind of camera.
_COUNTS = {"pinhole": 0, "none": 0, "radial1": 1, "radial3": 3, "radialk1": 1, "radialk3": 3}
_COUNTS |= {"brown": 5, "fisheye": 4, "fisheye4": 4}


def is_alicevision(path: Path) -> bool:
    """Whether a file starts like one of AliceVision."""
    head = parse.head_of(path)
    return (
        path.suffix.lower() in (".sfm", ".json")
        and b'"version"' in head
        and (b'"views"' in head or b'"featuresFolders"' in head)
    )


def read(path: Path, photos: PhotoFolder) -> Reconstruction:
    """Read cameras, and the points of the file or of a PLY file beside it."""
    scene = parse.table(path, parse.load_json(path))
    version = parse.numbers(f"{path}: version", scene.get("version"), 3)
    lenses = {
        str(each.get("intrinsicId")): _lens(f"{path}: intrinsic", each, tuple(version))
        for each in parse.objects(f"{path}: intrinsics", scene.get("intrinsics") or [])
    }
    poses = {
        str(each.get("poseId")): parse.table(f"{path}: pose", each.get("pose"))
        for each in parse.objects(f"{path}: poses", scene.get("poses") or [])
    }
    found = Reconstruction()
    for view in parse.objects(f"{path}: views", scene.get("views")):
        name = str(view.get("path"))
        where = f"{path}: view {quoted(name)}"
        found.total += 1
        with found.one(name):
            pose = poses.get(str(view.get("poseId", view.get("viewId"))))
            if pose is None:
                continue
            lens = lenses.get(str(view.get("intrinsicId")))
            if lens is None:
                raise parse.damaged(where, "has an intrinsic that is not in the file")
            transform = parse.table(where, pose.get("transform"))
            rotation = parse.numbers(where, transform.get("rotation"), 9).reshape(3, 3).T
            centre = parse.numbers(where, transform.get("center"), 3)
            cam = parse.rigid(where, rotation, -rotation @ centre)
            if (photo := found.photo(photos, name)) is None:
                continue
            found.add(photos, photo, lens, cam)
    points = parse.objects(f"{path}: structure", scene.get("structure") or [])
    rows = [(point.get("X"), point.get("color", [128] * 3)) for point in points]
    found.add_points(path, str(path), rows)
    if not rows and found.images:
        points_beside(path.parent, found)
    return found


def _lens(where: str, camera: dict[str, Any], version: tuple[float, ...]) -> Lens:
    kind = str(camera.get("type", "pinhole")).lower()
    if kind == "pinhole":  # since version 1.2.6, the distortion is apart
        kind = str(camera.get("distortionType", kind)).lower()
    if kind not in _COUNTS:
        raise UserError(
            "{where}: the camera model {kind} is not supported; export the scene as a COLMAP "
            "model (the node ExportColmap of Meshroom)",
            where=where,
            kind=quoted(kind),
        )
    width, height = parse.number(where, camera, "width"), parse.number(where, camera, "height")
    if "pxFocalLength" in camera:
        given = camera["pxFocalLength"]
        fx, fy = parse.numbers(where, given if isinstance(given, list) else [given, given], 2)
    else:
        sensor = parse.number(where, camera, "sensorWidth", 36.0)
        if not sensor > 0:
            raise parse.damaged(where, f"the sensor width {sensor:g} is not valid")
        fx = parse.number(where, camera, "focalLength") * width / sensor
        fy = fx / (parse.number(where, camera, "pixelRatio", 1.0) or 1.0)
    centre = parse.numbers(where, camera.get("principalPoint", [0, 0]), 2)
    if version < (1, 2, 1):  # from the corner of the photo
        centre = centre - (width / 2, height / 2)
    count = _COUNTS[kind]
    k = parse.numbers(where, camera.get("distortionParams") or [0.0] * count, count).tolist()
    cx, cy = centre + np.array([width / 2 + 0.5, height / 2 + 0.5])
    intrinsics = (float(fx), float(fy), float(cx), float(cy))
    if kind.startswith("fisheye"):
        return fisheye(where, width, height, intrinsics, k)
    return perspective(where, width, height, intrinsics, k[:3], k[3:] or (0.0, 0.0))


READER = program("AliceVision", ("*.sfm", "sfm.json"), is_alicevision, read)
