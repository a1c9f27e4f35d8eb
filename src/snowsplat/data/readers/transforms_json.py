"""transforms.json and similar files -> posed images and points.

Four variants of the format are supported:

- Synthetic Blender scenes: ``transforms_train.json``, ``transforms_test.json`` and
  ``transforms_val.json`` with ``camera_angle_x``; image names have no suffix.
- instant-ngp: ``transforms.json`` with intrinsics in pixels (``fl_x``, ``cx``, ``w`` …).
- NeRFCapture, and others for instant-ngp with depth: ``depth_path`` and ``integer_depth_scale``,
  the world units per integer of the depth maps.
- nerfstudio: as instant-ngp, but each frame may have its own intrinsics, and there may be
  ``ply_file_path``, ``mask_path``, ``depth_file_path`` and ``train_filenames``. Specification:
  https://docs.nerf.studio/quickstart/data_conventions.html

All variants store world_from_cam in OpenGL axes (x right, y up, z backward). It is converted to
cam_from_world in OpenCV axes. The world frame is neither centred nor scaled.
"""

import logging
import math
from collections import ChainMap
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from snowsplat.data.colmap.model import read_points
from snowsplat.data.colmap.places import find_models
from snowsplat.data.dataset import Points, PosedImage, safe_name, usable_points
from snowsplat.data.files.photo_files import find_photos, warn_of_missing, warn_of_unusable
from snowsplat.data.photos.decode import IMAGE_SUFFIXES
from snowsplat.data.points_ply import read_points as read_points_ply
from snowsplat.data.readers import parse
from snowsplat.data.readers.reconstruction import PhotoFolder, Reader, Reconstruction
from snowsplat.data.readers.transforms_lens import lens_of, stated
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import invert_rigid, transform_points
from snowsplat.util.errors import UserError
from snowsplat.util.messages import message
from snowsplat.util.safe_json import inside, is_file, quoted

logger = logging.getLogger(__name__)

# Converts OpenGL's camera axes to OpenCV's; it is its own inverse.
_FLIP = np.diag([1.0, -1.0, -1.0])

# Parts of a path of another computer that are tried.
_MOST_PARTS = 16
# Memory for JSON values per byte of the text.
_JSON_RATIO = 2
# Two statements of a focal length differ by less than this factor, or contradict each other.
_SAME_LENS = 1.05

_Json = dict[str, Any]
_Split = Literal["train", "test"]


def find(root: Path, images: str = "images", deep: bool = True) -> list[Path]:
    """The transforms files of a dataset: [training, test], [all images], or [] if there are none.

    ``root`` is a folder or a JSON file.
    """
    if root.is_file():
        return [root] if root.suffix.lower() == ".json" else []
    train, test, val = (root / f"transforms_{split}.json" for split in ("train", "test", "val"))
    if train.is_file():
        # The validation split replaces a missing test split; otherwise it is not used.
        return [train, *[path for path in (test, val) if path.is_file()][:1]]
    single = root / "transforms.json"
    return [single] if single.is_file() else []


def read(files: list[Path], photos: PhotoFolder) -> Reconstruction:
    """Read posed images that are on disk, and points.

    The folder of images of ``photos`` is used instead of ``images``, for example ``images_4``.

    Raises: UserError: a file is damaged or of another kind, or no image is there.
    """
    root = files[0].parent
    shown = " + ".join(path.name for path in files)
    frames, first_scene = _frames(files)
    found = _files_of(
        root / shown, root, [frame.name for frame in frames if frame.name], photos.images
    )
    split = _without_overlap(root, files, frames, found)
    result = Reconstruction(description=shown)
    seen: dict[tuple[str, _Split | None], Mapping[str, Any]] = {}
    for frame in frames:
        file = found.get(frame.name)
        values = {key: value for key, value in frame.values.maps[0].items() if key != "file_path"}
        with result.one(frame.name or frame.where):
            if not frame.name:
                raise parse.damaged(frame.where, "no file_path")
            if file is None or seen.get((file, frame.split)) == values:  # or the same again
                continue
            if (file, frame.split) in seen:
                raise UserError(
                    "{where}: the image {file} also belongs to another frame; remove one of them",
                    where=frame.where,
                    file=file,
                )
            first = not any(name == file for name, _ in seen)
            seen[file, frame.split] = values
            if first:
                result.images.append(
                    _posed_image(frame.where, root, file, frame.values, split[file])
                )
    missing = [frame.name for frame in frames if frame.name and frame.name not in found]
    warn_of_unusable(root / shown, result.unusable, len(result.images))
    if not result.images:
        if not missing:
            raise UserError("{file}: it has no frames; check where the images are", file=files[0])
        absent = root / safe_name(missing[0])
        others = [file.name for file in absent.parent.glob("*") if file.stem == absent.stem]
        problem = message("check where the images are")
        if others:
            problem = message("{file} is not read; convert them to PNG", file=quoted(others[0]))
        raise UserError(
            "{file}: all of its {count} images are missing (the first is {first}); {problem}",
            file=files[0],
            count=len(frames),
            first=quoted(missing[0]),
            problem=problem,
        )
    warn_of_missing(root / shown, missing, len(frames))
    result.points = _points(root, first_scene)
    return result


@dataclass(frozen=True)
class _Frame:
    where: str  # the start of error messages
    name: str  # its file_path
    values: ChainMap[str, Any]  # the entries of the frame, then those of the file
    split: _Split | None


def _frames(files: list[Path]) -> tuple[list[_Frame], _Json]:
    """The frames of all files, and the first file."""
    frames: list[_Frame] = []
    first_scene: _Json = {}
    for index, path in enumerate(files):
        scene = _read_json(path)
        _warn_of_contradictions(path, scene)
        first_scene = first_scene or scene
        split: _Split | None = None
        if len(files) > 1:
            split = "train" if index == 0 else "test"
        splits = _named_splits(scene)
        for number, frame in enumerate(scene["frames"]):
            where = f"{path}: frame {number}"
            frame = frame if isinstance(frame, dict) else {}
            name = frame.get("file_path")
            name = name if isinstance(name, str) else ""
            named = split or splits.get(safe_name(name))
            frames.append(_Frame(where, name, ChainMap(frame, scene), named))
    return frames, first_scene


def _without_overlap(
    root: Path, files: list[Path], frames: list[_Frame], found: Mapping[str, str]
) -> dict[str, _Split | None]:
    """The split of each image file. Logs a line if images are in both splits.

    Such images are held out. But if all images for training are held out, the second file says
    nothing about a split, for example as a copy of the first one.
    """
    splits: dict[str, set[_Split | None]] = {}
    for frame in frames:
        if frame.name in found:
            splits.setdefault(found[frame.name], set()).add(frame.split)
    both = {file for file, named in splits.items() if len(named) > 1}
    single = {file: next(iter(named)) for file, named in splits.items() if file not in both}
    if not both:
        return single
    shown = " and ".join(path.name for path in files)
    if "train" in single.values():
        logger.warning("%s: %d images are in both %s; they are held out", root, len(both), shown)
        return single | dict.fromkeys(both, "test")
    if "test" in single.values():
        logger.warning("%s: %d images are in both %s; trained on", root, len(both), shown)
        return single | dict.fromkeys(both, "train")
    logger.warning("%s: the same images are in %s, so this is no split", root, shown)
    return dict.fromkeys(both)


def _posed_image(
    where: str, root: Path, file: str, values: ChainMap[str, Any], split: _Split | None
) -> PosedImage:
    """The image ``root / file`` of a frame; ``values`` as in `lens_of`."""
    lens = lens_of(where, values, root / file)
    camera = Camera(lens.width, lens.height, *lens.intrinsics, _pose(where, values))
    return replace(
        PosedImage.below(root, file, camera, lens),
        mask=_mask(where, root, values.maps[0]),  # masks belong to frames, not to files
        split=split,
        depth=_depth_map(root, values.maps[0]),
        depth_unit=stated(where, values, "integer_depth_scale") or 1.0,
    )


def _read_json(path: Path) -> _Json:
    scene = parse.load_json(path, _JSON_RATIO)
    if not isinstance(scene, dict) or not isinstance(scene.get("frames"), list):
        raise UserError(
            "{path}: has no list of frames, so it does not describe a dataset", path=path
        )
    return scene


def _named_splits(scene: _Json) -> dict[str, _Split]:
    """The split of each image in nerfstudio's lists of files; keys are from `safe_name`."""
    splits: dict[str, _Split] = {}
    for key in ("val_filenames", "test_filenames", "train_filenames"):
        names = scene.get(key)
        for name in names if isinstance(names, list) else []:
            splits[safe_name(str(name))] = "train" if key == "train_filenames" else "test"
    return splits


def _path_inside(where: str, root: Path, name: str) -> Path:
    """``root / name``, or if that is not there, the end of ``name`` that is a path in ``root``.

    Raises: UserError: there is no such file, and ``root / name`` is outside the folder ``root``.
    """
    name = name.replace("\\", "/")
    path = inside(root, name)
    if path is None or not is_file(path):
        parts = [part for part in name.split("/") if part not in ("", ".", "..")]
        ends = ["/".join(parts[-count:]) for count in range(min(len(parts), _MOST_PARTS), 1, -1)]
        path = next((root / end for end in ends if is_file(root / end)), path)
    if path is None:
        raise UserError(
            "{where}: {name} is not in the folder of the JSON file; copy it there and use a "
            "relative path",
            where=where,
            name=quoted(name),
        )
    return path


def _files_of(where: Path, root: Path, names: Sequence[str], images: str) -> dict[str, str]:
    """The files that the names of images mean, relative to ``root``; see `find_photos`."""
    names = list(dict.fromkeys(names))
    found = {name: file for name in names if (file := _find_file(root, name, images))}
    if left := [name for name in names if name not in found]:
        found |= find_photos(where, root, left, set(found.values()))
    return found


def _find_file(root: Path, name: str, images: str) -> str | None:
    """The path of a frame's image relative to ``root``, if it is where its name says."""
    name = name.replace("\\", "/").removeprefix("./")
    if inside(root, name) is None:
        return None
    if images != "images" and name.startswith("images/"):
        name = f"{images}/{name.removeprefix('images/')}"
    for suffix in ("", *IMAGE_SUFFIXES, *(s.upper() for s in IMAGE_SUFFIXES)):
        if is_file(root / (name + suffix)):
            return name + suffix
    return None


def _mask(where: str, root: Path, frame: Mapping[str, Any]) -> Path | None:
    name = frame.get("mask_path")
    if not isinstance(name, str) or not name:
        return None
    path = _path_inside(where, root, name)
    if not is_file(path):
        raise UserError(
            "{where}: the mask {path} is missing; add it or remove its entry from the file",
            where=where,
            path=path,
        )
    return path


def _depth_map(root: Path, frame: Mapping[str, Any]) -> Path | None:
    """The depth map of a frame; None if it is missing, because most recipes do not need it."""
    name = frame.get("depth_file_path", frame.get("depth_path"))
    if not isinstance(name, str) or not name:
        return None
    with suppress(UserError):
        path = _path_inside("", root, name)
        return path if is_file(path) else None
    return None


def _warn_of_contradictions(path: Path, scene: _Json) -> None:
    """Warn if ``fl_x`` and ``camera_angle_x`` of the file are of different lenses."""
    for axis, side in (("x", "w"), ("y", "h")):
        focal, size, angle = (
            scene.get(key) for key in (f"fl_{axis}", side, f"camera_angle_{axis}")
        )
        numbers = [n for n in (focal, size, angle) if isinstance(n, int | float)]
        if len(numbers) < 3 or min(numbers) <= 0 or numbers[2] >= math.pi:
            continue
        stated = 0.5 * numbers[1] / math.tan(0.5 * numbers[2])
        if not 1 / _SAME_LENS < numbers[0] / stated < _SAME_LENS:
            logger.warning(
                "%s: fl_%s is %g pixels, but camera_angle_%s (%g°) is a focal length of %.5g "
                "pixels; fl_%s is used; remove the wrong one",
                path,
                axis,
                numbers[0],
                axis,
                math.degrees(numbers[2]),
                stated,
                axis,
            )
            return


def _pose(where: str, frame: Mapping[str, Any]) -> torch.Tensor:
    """cam_from_world (3, 4) float64, OpenCV axes, from the transform_matrix of a frame."""
    value = frame.get("transform_matrix")
    rows = 3 if isinstance(value, list) and len(value) == 3 else 4
    matrix = parse.numbers(f"{where}: transform_matrix", value, rows, 4)
    if rows == 4 and matrix[3, :3].any() and not matrix[:3, 3].any():
        problem = "transform_matrix is transposed: its last row must be 0 0 0 1, and its last "
        raise parse.damaged(where, f"{problem}column the position")
    axes = matrix[:3, :3]
    # A scaled camera object in Blender has a scaled matrix; only the directions are used. The
    # nearest rotation corrects rounding errors of exporters. Larger differences are an error.
    scale = np.cbrt(abs(np.linalg.det(axes)))
    u, _, vt = np.linalg.svd(axes / scale if scale > 1e-9 else np.zeros((3, 3)))
    rotation = u @ vt
    if scale <= 1e-9 or np.abs(rotation * scale - axes).max() > 1e-2 * scale:
        raise parse.damaged(where, "transform_matrix is not a rotation")
    if np.linalg.det(rotation) < 0:
        raise parse.damaged(where, "transform_matrix mirrors the world")
    world_from_cam = np.concatenate([rotation @ _FLIP, matrix[:3, 3:]], axis=1)
    return invert_rigid(torch.from_numpy(world_from_cam))


def _points(root: Path, scene: _Json) -> Points | None:
    """The point cloud of a dataset, in the world frame of its poses; None if there is none.

    ``ply_file_path`` is in that frame, and so is the ``points3d.ply`` of a Blender scene.
    nerfstudio stores the original COLMAP model, and in ``applied_transform`` and ``applied_scale``
    the similarity from the frame of that model to the frame of the poses.
    """
    named = scene.get("ply_file_path")
    path = root / "points3d.ply"
    if isinstance(named, str):
        path = _path_inside(f"{root}: ply_file_path", root, named)
    if is_file(path):
        return usable_points(path, *read_points_ply(path))
    if isinstance(named, str):
        logger.warning("%s: the point cloud (ply_file_path) is missing", path)
    models = find_models(root / "colmap" / "sparse")
    points = read_points(models[0]) if models and "applied_transform" in scene else None
    if points is None:
        return None
    try:
        transform = torch.tensor(scene["applied_transform"], dtype=torch.float64)[:3]
        scale = float(scene.get("applied_scale", 1.0))
        xyz = transform_points(transform, points.xyz.to(torch.float64)) * scale
    except (TypeError, ValueError, IndexError, RuntimeError, OverflowError):
        logger.warning("%s: applied_transform is not valid; COLMAP's points are not used", root)
        return None
    return usable_points(models[0], xyz.numpy(), points.rgb.numpy())


READER = Reader("transforms.json", find, read)
