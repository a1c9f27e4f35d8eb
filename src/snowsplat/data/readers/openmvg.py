"""OpenMVG: sfm_data.json. Poses are rotations cam_from_world, and centres, in OpenCV axes.

The centre of the first pixel is at (0, 0). Without "structure", the file has no points.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from snowsplat.data.lens.lens import Lens
from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import equirectangular, fisheye, perspective
from snowsplat.data.readers.points import points_beside
from snowsplat.data.readers.reconstruction import PhotoFolder, Reconstruction, program
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import quoted

# Each kind of camera: the name of its coefficients, and their number.
_DISTORTION = {
    "pinhole": ("", 0),
    "pinhole_radial_k1": ("disto_k1", 1),
    "pinhole_radial_k3": ("disto_k3", 3),
    "pinhole_brown_t2": ("disto_t2", 5),
    "fisheye": ("fisheye", 4),
    "spherical": ("", 0),
}
_NAMED = (1 << 30) - 1 | 1 << 30  # of an identifier; the highest bit tells that its name follows


def is_openmvg(path: Path) -> bool:
    """Whether a file starts like one of OpenMVG."""
    return path.suffix.lower() == ".json" and b'"sfm_data_version"' in parse.head_of(path)


def read(path: Path, photos: PhotoFolder) -> Reconstruction:
    """Read cameras and points."""
    scene = parse.table(path, parse.load_json(path))
    lenses = _lenses(path, scene)
    where = f"{path}: extrinsics"
    poses = {
        parse.number(where, pose, "key"): pose
        for pose in parse.objects(where, scene.get("extrinsics"))
    }
    found = Reconstruction()
    for view in parse.objects(f"{path}: views", scene.get("views")):
        data = _data(f"{path}: view", view)
        name = f"{data.get('local_path') or ''}/{data.get('filename')}"
        where = f"{path}: view {quoted(name)}"
        found.total += 1
        with found.one(name):
            key, pose_key = data.get("id_intrinsic"), data.get("id_pose")
            pose = poses.get(pose_key) if isinstance(pose_key, int) else None
            if pose is None:
                continue
            if not isinstance(key, int) or key not in lenses:
                raise parse.damaged(
                    where, f"has the intrinsic {quoted(key)}, which is not in the file"
                )
            values = parse.table(where, pose.get("value"))
            rotation = parse.numbers(where, values.get("rotation"), 3, 3)
            centre = parse.numbers(where, values.get("center"), 3)
            cam = parse.rigid(where, rotation, -rotation @ centre)
            if (photo := found.photo(photos, name)) is None:
                continue
            found.add(photos, photo, lenses[key], cam)
    points = parse.objects(f"{path}: structure", scene.get("structure") or [])
    rows = [(parse.table(path, point.get("value")).get("X"), [128] * 3) for point in points]
    if found.images:  # the points of the file have no colours
        points_beside(path.parent, found)
    if found.points is None:
        found.add_points(path, f"{path}: structure", rows)
    return found


def _data(where: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    """The object behind a pointer of the library that writes the file."""
    return parse.table(
        where,
        parse.table(where, parse.table(where, entry.get("value")).get("ptr_wrapper")).get("data"),
    )


def _lenses(path: Path, scene: dict[str, Any]) -> dict[int, Lens]:
    names: dict[int, str] = {}
    lenses = {}
    for entry in parse.objects(f"{path}: intrinsics", scene.get("intrinsics")):
        where = f"{path}: intrinsic {quoted(entry.get('key'))}"
        value = parse.table(where, entry.get("value"))
        identifier = value.get("polymorphic_id")
        if not isinstance(identifier, int) or not isinstance(entry.get("key"), int):
            raise parse.damaged(where, "has no identifier")
        # Only the first camera of a kind has the name of the kind.
        if isinstance(value.get("polymorphic_name"), str):
            names[identifier & _NAMED] = value["polymorphic_name"]
        lenses[entry["key"]] = _lens(where, names.get(identifier & _NAMED, ""), _data(where, entry))
    return lenses


def _lens(where: str, kind: str, data: dict[str, Any]) -> Lens:
    if kind not in _DISTORTION:
        raise UserError(
            "{where}: the camera model {kind} is not supported; export the scene with "
            "openMVG_main_openMVG2Colmap",
            where=where,
            kind=quoted(kind),
        )
    # Some versions nest the fields of the base class.
    while isinstance(data.get("value0"), dict):
        data = {**data["value0"], **{key: v for key, v in data.items() if key != "value0"}}
    width, height = parse.number(where, data, "width"), parse.number(where, data, "height")
    if kind == "spherical":
        return equirectangular(where, width, height)
    focal = parse.number(where, data, "focal_length")
    cx, cy = parse.numbers(where, data.get("principal_point"), 2) + 0.5
    name, count = _DISTORTION[kind]
    k = parse.numbers(where, data.get(name), count).tolist() if count else []
    intrinsics = (focal, focal, float(cx), float(cy))
    if kind == "fisheye":
        return fisheye(where, width, height, intrinsics, k)
    return perspective(where, width, height, intrinsics, k[:3], k[3:] or (0.0, 0.0))


READER = program("OpenMVG", ("sfm_data*.json",), is_openmvg, read)
