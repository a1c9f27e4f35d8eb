"""What a reader of this folder gets, a `PhotoFolder`, and what it returns, a `Reconstruction`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from snowsplat.data.dataset import Points, safe_name
from snowsplat.data.files.listing import folded
from snowsplat.data.files.photo_files import photos_below
from snowsplat.data.lens.lens import Lens
from snowsplat.data.photos.decode import IMAGE_SUFFIXES, is_photo
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.safe_json import is_file, quoted

# Smaller copies of the photos, whose folder may have any name.
_SMALLER = {"images_2", "images_4", "images_8"}


class PhotoFolder:
    """The photos in the folder of a dataset.

    Other programs name a photo by an absolute path of another computer, by its file name, or by its
    name without suffix. A photo is found by its path, or by its name if only one photo has it.

    Args:
        root: the folder that is searched; no photo outside of it is used.
        images: name of the folder of photos; photos elsewhere are used if it has the default name.

    Raises: SettingError: there is no folder ``images``, and it does not have the default name.
    """

    def __init__(self, root: Path, images: str = "images") -> None:
        self.root = root
        self._preferred = images
        if images != "images" and not (root / images).is_dir():
            raise SettingError(
                "images", "no such folder: {images}; use the right one", images=root / images
            )
        self._only = images != "images"
        self._by_name: dict[str, list[str]] | None = None

    def find(self, name: str) -> str | None:
        """The file of a photo, relative to the root, with "/"; None if it is not there.

        Raises: UserError: several photos have this name.
        """
        name = safe_name(name)
        if not name:
            return None
        for folder in (f"{self._preferred}/", *(() if self._only else ("",))):
            for suffix in ("", *IMAGE_SUFFIXES) if not is_photo(name) else ("",):
                if is_file(self.root / (folder + name + suffix)) and is_photo(name + suffix):
                    return folder + name + suffix
        last = folded(PurePosixPath(name).name)
        index = self._index()
        return self._nearest(name, index.get(last) or index.get(_stem(last)) or [])

    def sorted_files(self) -> list[str]:
        """The photos of the folder of images, or of the root if there is none, sorted by name."""
        folder = self.root / self._preferred
        prefix = f"{self._preferred}/" if folder.is_dir() else ""
        names = (path.name for path in (folder if prefix else self.root).iterdir())
        return [prefix + name for name in sorted(names) if is_photo(name)]

    def _nearest(self, name: str, found: list[str]) -> str | None:
        """The one of several files that has most folders in common with ``name``."""
        if len(found) < 2:
            return found[0] if found else None
        wanted = PurePosixPath(name).parts[-2::-1]

        def common(file: str) -> tuple[int, bool]:
            own = PurePosixPath(file).parts
            pairs = zip(wanted, own[-2::-1], strict=False)
            same = next((i for i, (a, b) in enumerate(pairs) if a != b), min(len(wanted), len(own)))
            return same, own[0] == self._preferred

        found = sorted(found, key=common, reverse=True)
        if common(found[0]) == common(found[1]):
            raise UserError(
                "{root}: has several photos named {name} ({found}, {found2}); keep only the "
                "right ones in its folder images",
                root=self.root,
                name=quoted(PurePosixPath(name).name),
                found=found[0],
                found2=found[1],
            )
        return found[0]

    def _index(self) -> dict[str, list[str]]:
        """The photos below the root, by their names and by their names without suffix."""
        if self._by_name is None:
            self._by_name = {}
            below = f"{self._preferred}/" if self._only else ""
            try:
                photos = photos_below(self.root / below)
            except OSError:  # a folder that cannot be read
                photos = []
            for photo in (p for p in photos if _SMALLER.isdisjoint(p.split("/"))):
                name = folded(PurePosixPath(photo).name)
                for key in {name, _stem(name)}:
                    self._by_name.setdefault(key, []).append(below + photo)
        return self._by_name


def _stem(name: str) -> str:
    """The name without the suffix of a photo; "IMG.0001" has none."""
    return name.rpartition(".")[0] if is_photo(name) else name


@dataclass(frozen=True, eq=False)
class Shot:
    """A photo with a pose."""

    photo: str  # relative to the root of the `PhotoFolder`
    lens: Lens
    cam_from_world: np.ndarray  # (3, 4) float64, OpenCV axes
    depth: Path | None = None
    depth_unit: float = 1.0  # as `PosedImage.depth_unit`
    depth_confidence: Path | None = None  # as `PosedImage.depth_confidence`


@dataclass(eq=False)
class Reconstruction:
    """The photos and points of a file; readers add to it while they read.

    Attributes:
        total: number of photos in the file, with and without poses.
        missing: names of photos with poses that are not on disk.
        points_from: the file of the points, if it is another one.
    """

    shots: list[Shot] = field(default_factory=list)
    total: int = 0
    missing: list[str] = field(default_factory=list)
    points: Points | None = None
    points_from: str = ""

    def photo(self, photos: PhotoFolder, name: str) -> str | None:
        """The result of `PhotoFolder.find`; a photo that is not there is added to ``missing``."""
        photo = photos.find(name)
        if photo is None:
            self.missing.append(name)
        return photo
