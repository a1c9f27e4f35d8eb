"""Record3D: the folder of an export with ``metadata.json``, ``rgb/0.jpg`` … and ``depth/0.exr`` …,
or an unpacked .r3d file with ``rgbd/0.jpg`` ….

A pose is a quaternion x, y, z, w and the position of the camera, with y up, looking along −z. Units
are metres.
"""

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch

from snowsplat.data.maps.map_files import MAP_SUFFIXES
from snowsplat.data.photos.decode import is_photo
from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import Intrinsics, perspective
from snowsplat.data.readers.reconstruction import PhotoFolder, Reconstruction, program
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import is_file

logger = logging.getLogger(__name__)

#: An export may be in the folder of its EXR files.
PATTERNS = ("metadata.json", "metadata", "EXR_RGBD/metadata.json")
_PACKED = ".r3d"
_DIGITS = re.compile(r"[0-9]{1,9}")
_FOLDERS = ("rgb", "rgbd", "images", "EXR_RGBD/rgb")


def is_record3d(path: Path) -> bool:
    """Whether a file is the metadata of a recording with poses, or a packed recording."""
    if path.suffix.lower() == _PACKED and is_file(path):
        return True
    if path.name not in ("metadata.json", "metadata") or not is_file(path):
        return False
    head = parse.head_of(path, 1 << 24)
    return b'"poses"' in head and b'"K"' in head


def photos(folder: Path) -> Path | None:
    """The folder of photos in an export."""
    path = next(filter(is_record3d, (folder / name for name in PATTERNS)), None)
    return path and next(filter(Path.is_dir, (path.parent / name for name in _FOLDERS)), None)


def read(path: Path, photos: PhotoFolder) -> Reconstruction:
    """Read cameras. Depth maps of .r3d files are not readable."""
    if path.suffix.lower() == _PACKED:
        raise UserError(
            "{path}: is packed; unpack it as a zip archive, or export EXR + RGB from Record3D, "
            "and use the folder",
            path=path,
        )
    values = parse.table(path, parse.load_json(path))
    poses = values.get("poses")
    if not isinstance(poses, list):
        raise parse.damaged(path, "has no list of poses")
    width, height = parse.number(path, values, "w"), parse.number(path, values, "h")
    frames = values.get("perFrameIntrinsicCoeffs")
    own = frames if isinstance(frames, list) and len(frames) == len(poses) else None
    intrinsics = _intrinsics(path, values)
    images = next((path.parent / n for n in _FOLDERS if (path.parent / n).is_dir()), path.parent)
    files = _frames(path, images, len(poses))
    found = Reconstruction(total=len(poses))
    compressed = False
    for index, entry in enumerate(poses):
        where = f"{path}: pose {index}"
        file = files.get(index)
        if file is None:
            found.missing.append(f"{images.name}/{index}.jpg")
            continue
        with found.one(file.name):
            pose = parse.numbers(where, entry, 7)
            if not 0.5 < np.linalg.norm(pose[:4]) < 2.0:
                raise parse.damaged(where, "the quaternion has no direction")
            if own is not None:
                fx, fy, cx, cy = parse.numbers(where, own[index], 4).tolist()
                intrinsics = (fx, fy, cx, cy)
            lens = perspective(where, width, height, intrinsics)
            rotation = rotation_from_quat(torch.from_numpy(pose[[3, 0, 1, 2]])).numpy()
            cam = parse.from_opengl(where, np.column_stack([rotation, pose[4:]]))
            names = (path.parent / "depth" / f"{file.stem}{suffix}" for suffix in MAP_SUFFIXES)
            depth = next((name for name in names if is_file(name)), None)
            compressed |= depth is None and is_file(file.with_suffix(".depth"))
            photo = file.relative_to(photos.root).as_posix()
            found.add(photos, photo, lens, cam, depth=depth)
    if compressed:
        logger.warning(
            "%s: the depth maps are compressed (LZFSE), which is not supported; not used; export "
            "the recording from Record3D as EXR + RGB",
            path.parent,
        )
    return found


def _frames(path: Path, images: Path, count: int) -> dict[int, Path]:
    """The photo of each pose: 0.jpg, 1.jpg …; with other names, the photos in their order.

    Raises: UserError: the photos have other names, and there are not as many as poses.
    """
    files = [file for file in sorted(images.iterdir()) if is_photo(file.name) and is_file(file)]
    numbered = {int(file.stem): file for file in files if _DIGITS.fullmatch(file.stem)}
    if len(numbered) == len(files) and max(numbered, default=0) < count:
        return numbered
    if len(files) != count:
        raise UserError(
            "{path}: has {count} poses, but there are {files} photos in {images}, which are not "
            "named 0.jpg, 1.jpg …; use the photos as Record3D has named them",
            path=path,
            count=count,
            files=len(files),
            images=images,
        )
    return dict(enumerate(files))


def _intrinsics(path: Path, values: dict[str, Any]) -> Intrinsics:
    """fx, fy, cx, cy from K, which is stored by columns; some converters store it by rows."""
    k = parse.numbers(f"{path}: K", values.get("K"), 9).reshape(3, 3).T
    k = k.T if k[2, 0] or k[2, 1] else k
    return float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])


READER = program("Record3D", PATTERNS, is_record3d, read, photos, 1.0)
