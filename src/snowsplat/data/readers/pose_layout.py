"""`Layout`: a table, or a folder of tables, of matrices that are the poses of photos."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from snowsplat.data.photos.decode import read_header
from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import Intrinsics, perspective
from snowsplat.data.readers.reconstruction import PhotoFolder, Reader, Reconstruction, program
from snowsplat.scene.geometry import rotation_from_quat
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import is_file, quoted

#: Files of a folder that are opened to recognise a layout.
TRIED = 3


@dataclass(frozen=True)
class Frame:
    """A photo and its pose.

    Attributes:
        photo: the file without its suffix, or with it.
        camera: where 7 numbers (position, quaternion x y z w), or 12 or 16 (rows of a matrix) are:
            a text file, a line, or a function that returns them and K of the photo.
        depth, confidence: files of maps, which need not exist.
        split: see `PosedImage`.
    """

    photo: str
    camera: Path | str | Callable[[], tuple[np.ndarray, Intrinsics | None]]
    depth: Path | None = None
    confidence: Path | None = None
    split: Literal["train", "test"] | None = None


@dataclass(frozen=True)
class Layout:
    """How poses are stored.

    Attributes:
        place: where in a dataset the file or folder of the poses is, as a pattern.
        files: of a folder, the files that have the poses; "": it is a file itself.
        start: how such a file begins.
        frames: the frames, from the path that was found and the photos.
        lens: the camera of all photos: fx, fy, cx, cy, and k1, k2, p1, p2, k3 if there is
            distortion; None if nothing tells it.
        depth_unit: world units per unit of a depth map.
        inverse: the matrices are cam_from_world.
        opengl: the axes of the cameras are those of OpenGL.
        metric: the world is in metres.
    """

    name: str
    place: str
    files: str
    start: bytes
    frames: Callable[[Path, PhotoFolder], Iterator[Frame]]
    lens: Callable[[Path], Sequence[float] | None]
    depth_unit: Callable[[Path], float] = lambda path: 1.0
    inverse: bool = False
    opengl: bool = False
    metric: bool = True

    def has_poses(self, path: Path) -> bool:
        """Whether a file or folder has poses in this layout."""
        if path.is_dir() != bool(self.files) or not path.match(self.place):
            return False
        found = islice(path.glob(self.files), TRIED) if self.files else [path]
        return any(re.match(self.start, parse.head_of(file)) for file in found)

    def is_one(self, path: Path) -> bool:
        """Whether a file or folder has poses in this layout, and their camera is known."""
        if not self.has_poses(path):
            return False
        try:
            return self.lens(path) is not None
        except UserError:  # reading tells why
            return True

    def read(self, path: Path, photos: PhotoFolder) -> Reconstruction:
        """Read the cameras."""
        shared = self.lens(path) or ()
        unit = self.depth_unit(path)
        found = Reconstruction()
        for frame in self.frames(path, photos):
            found.total += 1
            where = f"{path}: {quoted(frame.photo)}"
            with found.one(frame.photo):
                if callable(frame.camera):
                    pose, own = frame.camera()
                else:
                    text = frame.camera
                    text = parse.load_text(text) if isinstance(text, Path) else text
                    pose, own = floats(where, text), None
                if not np.isfinite(pose).all():  # tracking was lost
                    continue
                if (photo := found.photo(photos, frame.photo)) is None:
                    continue
                fx, fy, cx, cy, *rest = own or shared
                k1, k2, p1, p2, k3 = [*rest, 0.0, 0.0, 0.0, 0.0, 0.0][:5]
                header = read_header(photos.root / photo)
                size = header.width, header.height
                lens = perspective(where, *size, (fx, fy, cx, cy), (k1, k2, k3), (p1, p2))
                maps = {"depth": frame.depth, "depth_confidence": frame.confidence}
                maps = {key: file for key, file in maps.items() if file and is_file(file)}
                cam = self._cam_from_world(where, pose)
                found.add(photos, photo, lens, cam, depth_unit=unit, split=frame.split, **maps)
        return found

    def _cam_from_world(self, where: str, pose: np.ndarray) -> np.ndarray:
        """(3, 4)"""
        if len(pose) == 7:
            x, y, z, w = parse.numbers(where, pose, 7)[3:]
            if not 0.5 < np.linalg.norm((x, y, z, w)) < 2.0:
                raise parse.damaged(where, "the quaternion has no direction")
            rotation = rotation_from_quat(torch.tensor([w, x, y, z])).numpy()
            matrix = np.column_stack([rotation, pose[:3]])
        else:
            matrix = parse.numbers(where, pose, 16 if len(pose) == 16 else 12).reshape(-1, 4)[:3]
        if self.opengl:
            return parse.from_opengl(where, matrix)
        rigid = parse.rigid(where, matrix[:, :3], matrix[:, 3])
        return rigid if self.inverse else parse.inverse(rigid)

    def reader(self) -> Reader:
        """The reader of datasets with this layout."""
        metres = 1.0 if self.metric else None
        return program(self.name, (self.place,), self.is_one, self.read, metres_per_unit=metres)


def floats(where: object, text: str) -> np.ndarray:
    """The numbers in a text, which may be infinite. Raises `UserError` if it has others."""
    try:
        return np.array(text.split(), np.float64)
    except ValueError:
        raise parse.damaged(where, f"should be numbers, not {quoted(text[:80])}") from None
