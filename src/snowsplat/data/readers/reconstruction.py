"""What all readers have in common: `Reader`, the `PhotoFolder` that one gets, and the
`Reconstruction` that it returns."""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch

from snowsplat.data.dataset import Points, PosedImage, safe_name, usable_points
from snowsplat.data.files.listing import fold_name
from snowsplat.data.files.photo_files import photos_below, warn_of_missing, warn_of_unusable
from snowsplat.data.lens.lens import Lens
from snowsplat.data.photos.decode import IMAGE_SUFFIXES, is_photo
from snowsplat.data.readers import parse
from snowsplat.scene.camera import Camera
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.messages import Message, message
from snowsplat.util.safe_json import is_file, quoted

logger = logging.getLogger(__name__)

# Smaller copies of the photos, whose folder may have any name.
_SMALLER = {"images_2", "images_4", "images_8"}


class PhotoFolder:
    """The photos in the folder of a dataset.

    Other programs name a photo by an absolute path of another computer, by its file name, or by its
    name without suffix. A photo is found by its path, or by its name if only one photo has it.

    Args:
        root: the folder that is searched; no photo outside of it is used.
        images: name of the folder of photos; photos elsewhere are used if it has the default name.
    """

    def __init__(self, root: Path, images: str = "images") -> None:
        self.root = root
        self.images = images
        self._only = images != "images"
        self._by_name: dict[str, list[str]] | None = None

    def check(self) -> None:
        """Raise `SettingError` if there is no folder ``images``, and it has another name."""
        if self._only and not (self.root / self.images).is_dir():
            raise SettingError(
                "images",
                "no such folder: {images}; use the right one",
                images=self.root / self.images,
            )

    def find(self, name: str) -> str | None:
        """The file of a photo, relative to the root, with "/"; None if it is not there.

        Raises: UserError: several photos have this name.
        """
        name = safe_name(name)
        if not name:
            return None
        for folder in (f"{self.images}/", *(() if self._only else ("",))):
            for suffix in ("", *IMAGE_SUFFIXES) if not is_photo(name) else ("",):
                if is_file(self.root / (folder + name + suffix)) and is_photo(name + suffix):
                    return folder + name + suffix
        last = fold_name(PurePosixPath(name).name)
        index = self._index()
        return self._nearest(name, index.get(last) or index.get(_stem(last)) or [])

    def sorted_files(self) -> list[str]:
        """The photos of the folder of images, or of the root, or smaller copies; sorted by name."""
        for folder in (self.images, "", *sorted(_SMALLER)):
            if (place := self.root / folder).is_dir():
                names = (path.relative_to(self.root).as_posix() for path in place.iterdir())
                if found := sorted(filter(is_photo, names)):
                    if folder in _SMALLER:
                        logger.warning("%s: no larger photos are here; these are used", place)
                    return found
        return []

    def _nearest(self, name: str, found: list[str]) -> str | None:
        """The one of several files that has most folders in common with ``name``."""
        if len(found) < 2:
            return found[0] if found else None
        wanted = PurePosixPath(name).parts[-2::-1]

        def common(file: str) -> tuple[int, bool]:
            own = PurePosixPath(file).parts
            pairs = zip(wanted, own[-2::-1], strict=False)
            same = next((i for i, (a, b) in enumerate(pairs) if a != b), min(len(wanted), len(own)))
            return same, own[0] == self.images

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
            below = f"{self.images}/" if self._only else ""
            try:
                photos = photos_below(self.root / below)
            except OSError:  # a folder that cannot be read
                photos = []
            for photo in (p for p in photos if _SMALLER.isdisjoint(p.split("/"))):
                name = fold_name(PurePosixPath(photo).name)
                for key in {name, _stem(name)}:
                    self._by_name.setdefault(key, []).append(below + photo)
        return self._by_name


def _stem(name: str) -> str:
    """The name without the suffix of a photo; "IMG.0001" has none."""
    return name.rpartition(".")[0] if is_photo(name) else name


@dataclass(eq=False)
class Reconstruction:
    """The posed images and points of a dataset; readers add to it while they read.

    Attributes:
        images: those that are on disk.
        points: None: the dataset has none.
        description: the files that were read, for messages.
        metres_per_unit: of the world; None: it is not known.
        total: number of photos in the file, with and without poses.
        missing: names of photos with poses that are not on disk.
        unusable: the errors of photos that were left out.
        points_from: the file of the points, if it is another one.
    """

    images: list[PosedImage] = field(default_factory=list)
    points: Points | None = None
    description: str | Message = ""
    metres_per_unit: float | None = None
    total: int = 0
    missing: list[str] = field(default_factory=list)
    unusable: dict[str, UserError] = field(default_factory=dict)
    points_from: str = ""

    @contextmanager
    def one(self, name: str) -> Iterator[None]:
        """What is read of one photo: if its entry is damaged, the photo is left out."""
        try:
            yield
        except UserError as error:
            self.unusable[name] = error

    def photo(self, photos: PhotoFolder, name: str) -> str | None:
        """The result of `PhotoFolder.find`; a photo that is not there is added to ``missing``."""
        photo = photos.find(name)
        if photo is None:
            self.missing.append(name)
        return photo

    def add(
        self, photos: PhotoFolder, photo: str, lens: Lens, cam_from_world: np.ndarray, **maps: Any
    ) -> None:
        """Add a photo, by its file relative to the root of ``photos``, with its pose (3, 4) float64
        in OpenCV axes. ``maps``: those of `PosedImage`."""
        pose = torch.from_numpy(cam_from_world.copy())
        camera = Camera(lens.width, lens.height, *lens.intrinsics, pose)
        self.images.append(replace(PosedImage.below(photos.root, photo, camera, lens), **maps))

    def add_points(self, path: Path, where: str, rows: Iterable[Sequence[Any]]) -> None:
        """Take the points of the file ``path``: positions and colours in 0..255, from lists of
        numbers. ``where``: the start of error messages."""
        points = [[parse.numbers(where, values, 3) for values in row] for row in rows]
        if points:
            xyz, rgb = map(np.stack, zip(*points, strict=True))
            self.points = usable_points(path, xyz, np.clip(rgb, 0, 255))


@dataclass(frozen=True)
class Reader:
    """How the files are found and read that tell the poses of a dataset.

    Attributes:
        name: of the program or format, for messages.
        find: the files or folders that describe the cameras of the dataset in a folder, or the file
            itself; the best first. Its other arguments are the name of the folder of images, and
            whether to search folders that may be those of other photos.
        read: reads what ``find`` has found.
        photos: the folder of photos, if other images of the dataset are not photos.
    """

    name: str
    find: Callable[[Path, str, bool], list[Path]]
    read: Callable[[list[Path], PhotoFolder], Reconstruction]
    photos: Callable[[Path], Path | None] = lambda folder: None


def program(
    name: str,
    patterns: Sequence[str],
    is_one: Callable[[Path], bool],
    read: Callable[[Path, PhotoFolder], Reconstruction],
    photos: Callable[[Path], Path | None] = lambda folder: None,
    metres_per_unit: float | None = None,
) -> Reader:
    """The reader of the export of a program.

    Args:
        name: of the program.
        patterns: where in a dataset the files, or folders, are that describe its cameras; of those
            of one pattern, a larger file says more.
        is_one: whether a file or folder is one of them.
        read: reads one of them.
        photos: see `Reader`.
        metres_per_unit: of its world; None: it has any unit.
    """

    def find(root: Path, images: str = "images", deep: bool = True) -> list[Path]:
        if root.is_file():
            return [root] if is_one(root) else []
        for folder in (root, *_only_folder(root)):
            for pattern in patterns:
                found = [path for path in sorted(folder.glob(pattern)) if is_one(path)]
                if found:
                    return sorted(found, key=lambda path: -path.stat().st_size)
        return []

    def read_first(files: list[Path], folder: PhotoFolder) -> Reconstruction:
        folder.check()
        cameras = files[0]
        found = read(cameras, folder)
        warn_of_unusable(cameras, found.unusable, len(found.images))
        _report_missing(name, cameras, folder, found)
        aligned = len(found.images) + len(found.missing)
        found.description = message(
            "{program} {file}, {aligned} of {all} photos aligned",
            program=name,
            file=cameras.name,
            aligned=aligned,
            all=found.total,
        )
        if found.points_from:
            found.description = message(
                "{cameras}, points from {file}", cameras=found.description, file=found.points_from
            )
        found.metres_per_unit = metres_per_unit
        return found

    def photos_in(root: Path) -> Path | None:
        return next(filter(None, map(photos, (root, *_only_folder(root)))), None)

    return Reader(name, find, read_first, photos_in)


def _only_folder(folder: Path) -> list[Path]:
    """The subfolder, if a folder has one and no files; hidden ones do not count."""
    try:
        inside = [path for path in folder.iterdir() if not path.name.startswith((".", "__"))]
    except OSError:
        return []
    return inside if len(inside) == 1 and inside[0].is_dir() else []


def _report_missing(
    program: str, cameras: Path, folder: PhotoFolder, found: Reconstruction
) -> None:
    if not found.images:
        if not found.missing:
            none = message("no photos")
            if found.total:
                none = message("none of its {count} photos is aligned", count=found.total)
            raise UserError(
                "{cameras}: {none}; align them in {program}, or estimate the poses: snowsplat "
                "sfm PHOTOS -o DATASET",
                cameras=cameras,
                none=none,
                program=program,
            )
        raise UserError(
            "{cameras}: none of its {missing} photos (the first is {missing2}) is in {root}; "
            "copy them to {root2}",
            cameras=cameras,
            missing=len(found.missing),
            missing2=quoted(found.missing[0]),
            root=folder.root,
            root2=folder.root / "images",
        )
    aligned = len(found.missing) + len(found.images)
    warn_of_missing(cameras, found.missing, aligned, "photos")
    if found.points is None:
        with_depth = any(image.depth is not None for image in found.images)
        logger.warning(
            "%s: no points%s; a PLY file of them in %s is a better start",
            cameras,
            ", but depth maps, which --init depth uses" if with_depth else "",
            folder.root,
        )
