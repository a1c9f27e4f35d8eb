"""LLFF: poses_bounds.npy. It has no names: the photos are those of the folder, sorted by name.

A row has a matrix 3 × 5: world_from_cam with the axes down, right and backwards, and a column of
height, width and focal length of the photos in full size; two depths follow.
"""

from pathlib import Path

import numpy as np

from snowsplat.data.photos.image_file import reason_of
from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import centred_intrinsics, perspective
from snowsplat.data.readers.reconstruction import PhotoFolder, Reconstruction, program
from snowsplat.util.errors import Problem, UserError
from snowsplat.util.messages import message
from snowsplat.util.safe_json import is_file

_COLUMNS = 17
_MOST_ROWS = 1_000_000


def is_llff(path: Path) -> bool:
    """Whether a file has the name that LLFF uses."""
    return path.name == "poses_bounds.npy" and is_file(path)


def read(path: Path, photos: PhotoFolder) -> Reconstruction:
    """Read the cameras."""
    try:
        stored = np.load(path, mmap_mode="r", allow_pickle=False)
        if stored.ndim != 2 or stored.shape[1] != _COLUMNS or len(stored) > _MOST_ROWS:
            raise Problem("it has the shape {shape}", shape=stored.shape)
    except Exception as error:  # numpy raises many kinds
        raise parse.damaged(
            path, message("not a table of poses ({error})", error=reason_of(error))
        ) from None
    files = photos.sorted_files()
    if len(files) != len(stored):
        raise UserError(
            "{path}: has {rows} poses, but there are {files} photos in {root}; use exactly the "
            "photos that the poses were estimated from",
            path=path,
            rows=len(stored),
            files=len(files),
            root=photos.root,
        )
    found = Reconstruction(total=len(stored))
    for index, (file, row) in enumerate(zip(files, stored, strict=True)):
        where = f"{path}: pose {index}"
        with found.one(file):
            table = parse.numbers(where, row[:15].reshape(3, 5), 3, 5)
            down, right, back, position, (height, width, focal) = table.T
            lens = perspective(where, width, height, centred_intrinsics(width, height, focal))
            pose = parse.from_opengl(where, np.column_stack([right, -down, back, position]))
            found.add(photos, file, lens, pose)
    return found


READER = program("LLFF", ("poses_bounds.npy",), is_llff, read)
