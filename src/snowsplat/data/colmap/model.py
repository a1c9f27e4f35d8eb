"""Reading and writing a sparse COLMAP model, binary or text.

The format: https://colmap.github.io/format.html
"""

import logging
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from snowsplat.data.colmap import binary as binary_files
from snowsplat.data.colmap import text as text_files
from snowsplat.data.colmap.types import ColmapImage, ColmapModel, PointFile
from snowsplat.data.dataset import Points, usable_points
from snowsplat.data.lens.lens import Lens
from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import quat_from_rotation, rotation_from_quat
from snowsplat.util.errors import UserError

logger = logging.getLogger(__name__)

# A quaternion whose squared norm differs from 1 by less than this was a unit quaternion.
_ROUNDED = 1e-5


#: The files of a binary (False) and of a text model (True), and their suffix.
_FILES = {False: (binary_files, ".bin"), True: (text_files, ".txt")}


def model_is_text(folder: Path) -> bool | None:
    """Whether the model in a folder is text (True) or binary (False); None if there is no model."""
    for is_text, (_, suffix) in _FILES.items():
        if all((folder / (name + suffix)).is_file() for name in ("cameras", "images")):
            return is_text
    return None


def count_images(folder: Path) -> int:
    """Number of registered images of the model in a folder; 0 if a file is damaged.

    Of a binary model, only the head of ``images.bin`` is read.
    """
    if not model_is_text(folder):
        return binary_files.count_images(folder / "images.bin")
    try:
        return len(text_files.read_images(folder / "images.txt"))
    except UserError:
        return 0


def read_model(folder: Path) -> ColmapModel:
    """Read cameras and images of the model in a folder; images are sorted by name.

    Raises: UserError: there is no model, or a file is damaged. The message names the file.
    """
    is_text = model_is_text(folder)
    if is_text is None:
        raise UserError(
            "{folder}: no COLMAP model here (cameras and images, .bin or .txt)", folder=folder
        )
    files, suffix = _FILES[is_text]
    cameras = files.read_cameras(folder / f"cameras{suffix}")
    images = files.read_images(folder / f"images{suffix}")
    ordered = sorted(images, key=lambda image: image.name)
    return ColmapModel(folder, is_text, cameras, ordered, _read_frames(folder, is_text))


def _read_frames(folder: Path, is_text: bool) -> dict[int, int]:
    """`ColmapModel.frames`; empty with a warning if the file is damaged: it is used for no pose."""
    files, suffix = _FILES[is_text]
    path = folder / f"frames{suffix}"
    if not path.is_file():  # of COLMAP before version 3.12
        return {}
    try:
        frames = files.read_frames(path)
    except UserError as error:
        logger.warning("%s", error)
        return {}
    return {image: number for number, images in frames if len(images) > 1 for image in images}


def read_points(folder: Path) -> Points | None:
    """Read the 3D points of the model in a folder, without tracks; None if it has none.

    `usable_points` removes points that are not finite or implausibly far away.

    Raises: UserError: a file is damaged.
    """
    if (found := read_point_file(folder)) is None:
        return None
    path, points = found
    return usable_points(path, points.xyz, points.rgb)


def read_point_file(folder: Path) -> tuple[Path, PointFile] | None:
    """The file of the points of the model in a folder, and what is in it; None if it has none.

    Raises: UserError: the file is damaged.
    """
    for files, suffix in _FILES.values():
        path = folder / f"points3D{suffix}"
        if path.is_file():
            return path, files.read_points(path)
    return None


def read_observations(
    model: ColmapModel, wanted: Mapping[int, np.ndarray]
) -> dict[int, np.ndarray]:
    """Read some observations of the images of a model; see `binary.read_observations`."""
    files, suffix = _FILES[model.text]
    return files.read_observations(model.folder / f"images{suffix}", wanted)


def write_model(
    folder: Path,
    cameras: Mapping[int, Lens],
    images: Sequence[ColmapImage],
    xyz: np.ndarray,
    rgb: np.ndarray,
    tracks: Sequence[Sequence[tuple[int, int]]] | None = None,
    *,
    text: bool = False,
) -> None:
    """Write a sparse model: the files cameras, images and points3D, as .bin or .txt.

    Args:
        folder: where to write; created if missing.
        cameras: by camera id.
        images: get the ids 1, 2, … in this order. They are written without observations.
        xyz: (P, 3) float, point positions in the world frame.
        rgb: (P, 3) uint8.
        tracks: per point, the pairs (image id, observation index) that observe it; None: no tracks.
        text: write .txt files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tracks = [()] * len(xyz) if tracks is None else tracks
    files, suffix = _FILES[text]
    points = zip(xyz.tolist(), rgb.tolist(), tracks, strict=True)
    records = {
        "cameras": [files.camera_record(*each) for each in cameras.items()],
        "images": [files.image_record(*each) for each in enumerate(images, 1)],
        "points3D": [files.point_record(i, *each) for i, each in enumerate(points, 1)],
    }
    for name, of_name in records.items():
        files.write_records(folder / f"{name}{suffix}", of_name)


def write_posed(
    folder: Path,
    posed: Iterable[tuple[str, Lens, Tensor]],
    xyz: np.ndarray | None = None,
    rgb: np.ndarray | None = None,
    tracks: Sequence[Sequence[tuple[int, int]]] | None = None,
    *,
    text: bool = False,
) -> None:
    """`write_model` of images whose poses are matrices; equal lenses become one camera.

    Args:
        posed: name, lens and ``cam_from_world`` (3, 4) of each image.
        xyz, rgb: the points; None: there are none.
    """
    numbers: dict[Lens, int] = {}
    images = []
    for name, lens, pose in posed:
        number = numbers.setdefault(lens, len(numbers) + 1)
        quat = quat_from_rotation(pose[:, :3]).tolist()
        images.append(ColmapImage(name, number, (*quat, *pose[:, 3].tolist())))
    xyz = np.zeros((0, 3)) if xyz is None else xyz
    rgb = np.zeros((0, 3), np.uint8) if rgb is None else rgb
    cameras = {number: lens for lens, number in numbers.items()}
    write_model(folder, cameras, images, xyz, rgb, tracks, text=text)


def posed_camera(model: ColmapModel, image: ColmapImage) -> Camera:
    """The camera of an image, with its pose in float64. A distortion of its lens is left out.

    Raises: UserError: the camera is missing or damaged.
    """
    colmap = model.cameras.get(image.camera_id)
    if colmap is None:
        raise UserError(
            "{folder}: image {name} has camera {camera_id}, which the model does not contain; "
            "copy the model again",
            folder=model.folder,
            name=image.name[:80],
            camera_id=image.camera_id,
        )
    fx, fy, cx, cy = colmap.intrinsics
    numbers = (fx, fy, cx, cy, *colmap.params)
    if min(fx, fy) <= 0 or not all(abs(number) < 1e9 for number in numbers):
        raise UserError(
            "{folder}: the intrinsics of a camera are damaged ({model} {str}); copy the model "
            "again",
            folder=model.folder,
            model=colmap.model,
            str=" ".join(map(str, colmap.params)),
        )
    quat, translation = torch.tensor(image.pose, dtype=torch.float64).split([4, 3])
    if not (0.5 < float(quat.norm()) < 2.0 and float(translation.abs().max()) < 1e15):
        raise UserError(
            "{folder}: the pose of image {name} is damaged; copy the model again",
            folder=model.folder,
            name=image.name[:80],
        )
    rotation = rotation_from_quat(quat)
    # COLMAP and its scripts compute R and t = −R C from a quaternion as it is, without dividing by
    # its norm. If C is far from 0, this R restores C even if the quaternion is rounded.
    norm2 = quat.square().sum()
    if abs(float(norm2) - 1.0) < _ROUNDED:
        identity = torch.eye(3, dtype=torch.float64)
        rotation = identity + norm2 * (rotation - identity)
    pose = torch.cat([rotation, translation[:, None]], 1)
    return Camera(colmap.width, colmap.height, fx, fy, cx, cy, pose)
