"""Bundler: bundle.out and a list of photos, which RealityScan, VisualSFM and others export too.

A camera has the axes of OpenGL: y is up, and it looks along −z. The origin of the photo is its
centre. https://www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html describes the format.
"""

import re
from pathlib import Path

import numpy as np

from snowsplat.data.photos.decode import read_header
from snowsplat.data.readers import parse
from snowsplat.data.readers.lenses import centred_intrinsics, perspective
from snowsplat.data.readers.reconstruction import PhotoFolder, Reconstruction, program
from snowsplat.util.errors import UserError

#: Other files than bundle.out may be of an earlier step.
PATTERNS = ("bundle.out", "*.out", "bundle/bundle.out", "bundle/*.out")
# "photo.jpg 0 1500.2": a focal length from EXIF may follow the name.
_FOCAL = re.compile(r"\s+\d+(\s+[-+.\deE]+)?$")
_FLIP = np.diag([1.0, -1.0, -1.0])


def is_bundler(path: Path) -> bool:
    """Whether a file starts like one of Bundler."""
    return parse.head_of(path).lstrip().lower().startswith(b"# bundle file")


def read(path: Path, photos: PhotoFolder) -> Reconstruction:
    """Read cameras and points."""
    lines = (
        line for line in parse.load_text(path).splitlines() if line[:1] != "#" and line.strip()
    )
    cameras, count = parse.numbers(path, next(lines, "").split(), 2).astype(int).tolist()
    names = _names(path, photos.root, cameras)
    found = Reconstruction(total=cameras)
    for index, name in enumerate(names):
        where = f"{path}: camera {index}"
        entry = [next(lines, "").split() for _ in range(5)]
        with found.one(name):
            focal, k1, k2 = parse.numbers(where, entry[0], 3)
            rows = [parse.numbers(where, row, 3) for row in entry[1:]]
            if focal == 0:  # not aligned
                continue
            if (photo := found.photo(photos, name)) is None:
                continue
            header = read_header(photos.root / photo)
            size = header.width, header.height
            lens = perspective(where, *size, centred_intrinsics(*size, focal), (k1, k2))
            pose = parse.rigid(where, _FLIP @ np.stack(rows[:3]), _FLIP @ rows[3])
            found.add(photos, photo, lens, pose)
    # The third line of a point lists the photos that show it.
    lists = ([next(lines, "").split() for _ in range(3)][:2] for _ in range(count))
    found.add_points(path, str(path), lists)
    return found


def _names(path: Path, root: Path, count: int) -> list[str]:
    """The photos in the order of the cameras, from a list in a text file beside ``path``."""
    folders = dict.fromkeys((path.parent, root, root / "prepare"))
    lists = [f for folder in folders for p in ("*.lst", "*.txt") for f in sorted(folder.glob(p))]
    for file in lists:
        names = [line.strip() for line in parse.load_text(file).splitlines() if line.strip()]
        if names[:1] == [str(count)]:  # some lists start with their length
            names = names[1:]
        names = [_FOCAL.sub("", name) for name in names]
        if len(names) == count and all("." in name[-6:] for name in names):
            return names
    raise UserError(
        "{path}: no list of its {count} photos beside it (list.txt, or .lst of RealityScan); add "
        "the list that was exported with it",
        path=path,
        count=count,
    )


READER = program("Bundler", PATTERNS, is_bundler, read)
