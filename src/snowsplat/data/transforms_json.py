"""transforms.json and its relatives -> posed images and points.

One family of files with three spellings. Blender's synthetic scenes: ``transforms_train.json``,
``_test``, ``_val``, with ``camera_angle_x`` and names without ending. instant-ngp:
``transforms.json`` with ``fl_x``, ``cx``, ``w`` … in pixels. nerfstudio: the same, where each
frame may have its own, and ``ply_file_path``, ``mask_path``, ``train_filenames``. Specification:
https://docs.nerf.studio/quickstart/data_conventions.html

All give world_from_cam in OpenGL axes (x right, y up, z backward); here it becomes cam_from_world
in OpenCV axes. Worlds are taken as they are, neither centred nor scaled.
"""

from __future__ import annotations

import logging
import math
from collections import ChainMap
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from snowsplat.data.colmap import find_models, read_points
from snowsplat.data.dataset import Points, PosedImage, safe_name, usable_points
from snowsplat.data.decode import IMAGE_SUFFIXES, read_header
from snowsplat.data.points_ply import read_points as read_points_ply
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import invert_rigid, transform_points
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import inside, is_file, quoted, read_json

logger = logging.getLogger(__name__)

_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
# From OpenGL's camera axes to OpenCV's and back.
_FLIP = np.diag([1.0, -1.0, -1.0])

_Json = dict[str, Any]
_Split = Literal["train", "test"]


def find_transforms(root: Path) -> list[Path]:
    """The files that describe a dataset in ``root``, or [] (``root`` may be such a file itself)."""
    if root.is_file():
        return [root] if root.suffix.lower() == ".json" else []
    train, test, val = (root / f"transforms_{split}.json" for split in ("train", "test", "val"))
    if train.is_file():
        # Where there is a test split, the validation split is for tuning and belongs to neither.
        return [train, *[path for path in (test, val) if path.is_file()][:1]]
    whole = root / "transforms.json"
    return [whole] if whole.is_file() else []


def read_nerf(files: list[Path], images: str) -> tuple[list[PosedImage], Points | None, str]:
    """Posed images that are on disk, points, and a description.

    Args:
        files: from `find_transforms`: one, or training and test.
        images: another name for the folder ``images``, as with COLMAP; "images" changes nothing.

    Raises:
        UserError: files that are damaged or not of this kind, distorted cameras, no images.
    """
    posed: dict[str, PosedImage] = {}
    missing: list[str] = []
    frame_count = 0
    first_scene: _Json = {}
    for index, path in enumerate(files):
        scene = _read_json(path)
        first_scene = first_scene or scene
        split: _Split | None = None
        if len(files) > 1:
            split = "train" if index == 0 else "test"
        splits = _named_splits(scene)
        for number, frame in enumerate(scene["frames"]):
            where = f"{path}: frame {number}"
            if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
                raise UserError(f"{where} has no file_path; export the file again")
            frame_count += 1
            file = _find_file(where, path.parent, frame["file_path"], images)
            if file is None:
                missing.append(frame["file_path"][:80])
                continue
            values = ChainMap(frame, scene)
            _check_model(where, values)
            camera = _camera(where, values, path.parent / file)
            name = safe_name(file)
            first, slash, _ = file.partition("/")
            folder = path.parent / first if first and slash else (path.parent / file).parent
            if name in posed:
                raise UserError(f"{where} has the image {file}, as another one has; remove one")
            posed[name] = PosedImage(
                name,
                camera,
                folder,
                (path.parent / file).relative_to(folder).as_posix(),
                _mask(where, path.parent, frame),
                split or splits.get(safe_name(frame["file_path"])),
            )
    shown = " + ".join(path.name for path in files)
    if not posed:
        problem = (
            f"none of its {frame_count} images is there" if frame_count else "it has no frames"
        )
        hint = f" (the first is {missing[0]!r})" if missing else ""
        raise UserError(f"{files[0]}: {problem}{hint}; check where the images are")
    if missing:
        logger.warning(
            "%s: %d of %d images are missing (the first is %r); skipped",
            files[0].parent / shown,
            len(missing),
            frame_count,
            missing[0],
        )
    return list(posed.values()), _points(files[0].parent, first_scene), shown


def _read_json(path: Path) -> _Json:
    try:
        scene = read_json(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
    except ValueError as error:  # not JSON, or not even text
        raise UserError(
            f"{path}: not a whole JSON file ({str(error)[:80]}); copy it again"
        ) from None
    if not isinstance(scene, dict) or not isinstance(scene.get("frames"), list):
        raise UserError(f"{path}: has no list of frames, so it does not describe a dataset")
    return scene


def _check_model(where: str, values: Mapping[str, Any]) -> None:
    model = str(values.get("camera_model", "PINHOLE")).upper()
    if model not in _PINHOLE_MODELS or values.get("is_fisheye"):
        kind = model if model not in _PINHOLE_MODELS else "fisheye"
        raise UserError(
            f"{where}: its camera model is {kind[:40]}, but Gaussians need pinhole cameras; "
            "make a dataset of the photos anew: snowsplat sfm PHOTOS -o DATASET"
        )


def _named_splits(scene: _Json) -> dict[str, _Split]:
    """nerfstudio's own lists of files, by `safe_name`."""
    splits: dict[str, _Split] = {}
    for key in ("val_filenames", "test_filenames", "train_filenames"):
        names = scene.get(key)
        for name in names if isinstance(names, list) else []:
            splits[safe_name(str(name))] = "train" if key == "train_filenames" else "test"
    return splits


def _at_home(where: str, root: Path, name: str) -> Path:
    """``root / name``, where the name does not lead out of the folder ``root``."""
    path = inside(root, name.replace("\\", "/"))
    if path is None:
        raise UserError(
            f"{where} names {quoted(name)}, which is not in the folder of the file; copy it there "
            "and name it from there"
        )
    return path


def _find_file(where: str, root: Path, name: str, images: str) -> str | None:
    """The image that a frame names, as a path from ``root``; None if it is absent."""
    name = name.replace("\\", "/").removeprefix("./")
    _at_home(where, root, name)  # what is left of ".//x" is no longer relative
    if images != "images" and name.startswith("images/"):
        name = f"{images}/{name.removeprefix('images/')}"
    for suffix in ("", *IMAGE_SUFFIXES, *(s.upper() for s in IMAGE_SUFFIXES)):
        if is_file(root / (name + suffix)):
            return name + suffix
    return None


def _mask(where: str, root: Path, frame: _Json) -> Path | None:
    name = frame.get("mask_path")
    if not isinstance(name, str) or not name:
        return None
    path = _at_home(where, root, name)
    if not is_file(path):
        raise UserError(
            f"{where} names the mask {path}, which is absent; add it or remove its entry"
        )
    return path


def _number(where: str, values: Mapping[str, Any], key: str) -> float | None:
    value = values.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UserError(f"{where}: {key} should be a number, not {quoted(value)}")
    if not abs(value) < 1e9:  # not a number, or a damaged one
        raise UserError(f"{where}: {key} is {str(value)[:40]}, which makes no sense")
    return float(value)


def _camera(where: str, values: Mapping[str, Any], image: Path) -> Camera:
    """The camera of a frame; ``values`` are the file's, overridden by the frame's own."""
    distortion = {key: _number(where, values, key) for key in _DISTORTION}
    if any(distortion.values()):
        shown = ", ".join(f"{key} = {value:g}" for key, value in distortion.items() if value)
        raise UserError(
            f"{where}: the lens is distorted ({shown}), and Gaussians are drawn without; "
            "make a dataset of the photos anew: snowsplat sfm PHOTOS -o DATASET"
        )
    width, height = _number(where, values, "w"), _number(where, values, "h")
    if width is None or height is None:
        header = read_header(image)
        width, height = header.width, header.height
    if width < 1 or height < 1:
        raise UserError(f"{where}: an image size of {width:g}x{height:g} makes no sense")
    width, height = round(width), round(height)
    fx, fy = _focal(where, values, "x", width), _focal(where, values, "y", height)
    fx, fy = fy if fx is None else fx, fx if fy is None else fy  # square pixels if one is told
    if fx is None or fy is None:
        raise UserError(f"{where}: has no focal length (fl_x or camera_angle_x); export it again")
    if fx <= 0 or fy <= 0:
        raise UserError(f"{where}: focal lengths of {fx:g} and {fy:g} pixels make no sense")
    cx, cy = _number(where, values, "cx"), _number(where, values, "cy")
    return Camera(
        width,
        height,
        fx,
        fy,
        width / 2 if cx is None else cx,
        height / 2 if cy is None else cy,
        _pose(where, values),
    )


def _focal(where: str, values: Mapping[str, Any], axis: str, size: int) -> float | None:
    """Focal length in pixels along an axis, from any of its spellings."""
    pixels = _number(where, values, f"fl_{axis}")
    if pixels is not None:
        return pixels
    angle = _number(where, values, f"camera_angle_{axis}")
    degrees = _number(where, values, f"{axis}_fov")
    if angle is None and degrees is not None:
        angle = math.radians(degrees)
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise UserError(f"{where}: a field of view of {math.degrees(angle):g}° makes no sense")
    return 0.5 * size / math.tan(0.5 * angle)


def _pose(where: str, frame: Mapping[str, Any]) -> torch.Tensor:
    """cam_from_world (3, 4) float64, OpenCV axes, of a frame's transform_matrix."""
    try:
        matrix = np.array(frame["transform_matrix"], np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not (np.abs(matrix) < 1e15).all():
        raise UserError(f"{where}: transform_matrix should be 4 rows of 4 numbers; export it again")
    axes = matrix[:3, :3]
    # A scaled camera object gives a scaled matrix; only its directions matter. Rounding of
    # exporters is mended by the nearest rotation, anything worse is no rotation.
    scale = np.cbrt(abs(np.linalg.det(axes)))
    u, _, vt = np.linalg.svd(axes / scale if scale > 1e-9 else np.zeros((3, 3)))
    rotation = u @ vt
    if scale <= 1e-9 or np.abs(rotation * scale - axes).max() > 1e-2 * scale:
        raise UserError(f"{where}: transform_matrix holds no rotation; export it again")
    if np.linalg.det(rotation) < 0:
        raise UserError(f"{where}: transform_matrix mirrors the world; export it again")
    world_from_cam = np.concatenate([rotation @ _FLIP, matrix[:3, 3:]], axis=1)
    return invert_rigid(torch.from_numpy(world_from_cam))


def _points(root: Path, scene: _Json) -> Points | None:
    """The point cloud that belongs to a dataset, in the frame of its poses.

    ``ply_file_path`` is in that frame. So is ``points3d.ply`` beside Blender scenes. nerfstudio
    keeps the COLMAP model it began with, and notes in ``applied_transform`` what it did to it
    since.
    """
    named = scene.get("ply_file_path")
    path = root / "points3d.ply"
    if isinstance(named, str):
        path = _at_home(f"{root}: ply_file_path", root, named)
    if is_file(path):
        return usable_points(path, *read_points_ply(path))
    if isinstance(named, str):
        logger.warning("%s: the points it should begin with are missing", path)
    models = find_models(root / "colmap" / "sparse")
    points = read_points(models[0]) if models and "applied_transform" in scene else None
    if points is None:
        return None
    try:
        transform = torch.tensor(scene["applied_transform"], dtype=torch.float64)[:3]
        scale = float(scene.get("applied_scale", 1.0))
        xyz = transform_points(transform, points.xyz.to(torch.float64)) * scale
    except (TypeError, ValueError, IndexError, RuntimeError, OverflowError):
        logger.warning("%s: applied_transform makes no sense; COLMAP's points are left out", root)
        return None
    return usable_points(models[0], xyz.numpy(), points.rgb.numpy())
